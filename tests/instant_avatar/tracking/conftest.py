"""A video and nothing else: no poses, no masks, no cameras."""

import shutil
from pathlib import Path

import pytest

from capture.source import RgbImage
from capture.source_opening import open_source
from instant_avatar.studio.shoot import ShootConfig
from tests.instant_avatar.conftest import film_without_novel_views


@pytest.fixture(scope="session")
def filmed(tmp_path_factory) -> Path:
    """A capture folder with the truth: 20 frames of 256 px."""
    folder = tmp_path_factory.mktemp("filmed") / "capture"
    film_without_novel_views(folder, ShootConfig(frames=20, size=256))
    return folder


@pytest.fixture(scope="session")
def frames(filmed) -> list[RgbImage]:
    """Its frames."""
    return [frame.rgb for frame in open_source(filmed).frames()]


@pytest.fixture
def video(filmed, tmp_path) -> Path:
    """Its video alone."""
    copy = tmp_path / "film" / "video.mp4"
    copy.parent.mkdir()
    shutil.copyfile(filmed / "video.mp4", copy)
    return copy
