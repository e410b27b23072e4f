"""Capture: where pixels come from, and where each pixel looks."""

from capture.camera import Camera as Camera
from capture.frame import Frame as Frame
