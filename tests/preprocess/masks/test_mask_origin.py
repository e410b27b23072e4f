"""Tests for segmenters: this project's own by name, and those of other packages."""

import pytest

from capture.input_error import InputError
from preprocess import plugins
from preprocess.blazepose.blazepose_segmenter import BlazePoseSegmenter
from preprocess.masks.mask_origin import make_segmenter, segmenter_name


def test_a_segmenter_is_named_by_its_prefix():
    assert segmenter_name("segmenter:blazepose") == "blazepose"
    assert segmenter_name("masks/") is None
    assert segmenter_name(None) is None


def test_the_own_segmenter_is_made_by_its_name(shaped):
    assert isinstance(make_segmenter("blazepose", shaped), BlazePoseSegmenter)


class Point:
    """An installed package's entry point."""

    def __init__(self, name, load):
        self.name, self.load = name, load


def test_another_packages_segmenter_is_made_for_the_body(monkeypatch, shaped):
    made = []

    def load():
        return lambda body: made.append(body) or (lambda frame, pose, camera: frame)

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    assert make_segmenter("rembg", shaped)(1, None, None) == 1
    assert made == [shaped]
    with pytest.raises(InputError, match="installed are blazepose, rembg"):
        make_segmenter("sam", shaped)


def test_a_segmenter_that_cannot_be_loaded_is_named(monkeypatch, shaped):
    def load():
        raise ImportError("no module named rembg")

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    with pytest.raises(InputError, match=r"'rembg' could not be loaded: no module named rembg"):
        make_segmenter("rembg", shaped)
