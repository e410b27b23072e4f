"""A video and nothing else: no poses, no masks, no cameras."""

import shutil
from pathlib import Path

import pytest

from instant_avatar.studio.shoot import ShootConfig, film_capture


@pytest.fixture(scope="session")
def filmed(tmp_path_factory) -> Path:
    """A capture folder with the truth: 20 frames of 256 px."""
    folder = tmp_path_factory.mktemp("filmed") / "capture"
    film_capture(folder, ShootConfig(frames=20, size=256))
    return folder


@pytest.fixture
def video(filmed, tmp_path) -> Path:
    """Its video alone."""
    copy = tmp_path / "film" / "video.mp4"
    copy.parent.mkdir()
    shutil.copyfile(filmed / "video.mp4", copy)
    return copy
