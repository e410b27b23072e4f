"""Where a moving camera stood: solved from its pictures alone, checked, and made metric."""

from preprocess.solve.solved import CameraSolution as CameraSolution
