"""Structure from motion: solve the cameras of a moving phone."""

from preprocess.sfm.camera_solution import CameraSolution as CameraSolution
