"""Capture: where pixels come from, and where each pixel looks."""

from capture.camera import Camera as Camera
from capture.input_error import InputError as InputError
from capture.source import Frame as Frame
from capture.source import FrameSource as FrameSource
