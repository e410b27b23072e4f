"""OpenCV without its noise on stderr: what is wrong with a file is said in our own words."""

import os
from functools import cache

LOG_LEVEL_SILENT = 0
"""OpenCV's own number."""


@cache
def silence_opencv() -> None:
    """Silences OpenCV and its FFmpeg; to be called before a file is opened."""
    import cv2  # heavy, and this file must not make others so

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when FFmpeg is first used
    set_level = getattr(cv2, "setLogLevel", None)  # OpenCV 4 has it here, OpenCV 5 there
    (set_level or cv2.utils.logging.setLogLevel)(LOG_LEVEL_SILENT)
