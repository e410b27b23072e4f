"""Which masks are used of those that could be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture.source_opening import open_source
from preprocess.capture_inputs import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture

FRAMES = 4
ESTIMATED, ALPHA = "estimated by BlazePose", "alpha channel"


@pytest.fixture(scope="module")
def shots(film) -> list[tuple[np.ndarray, np.ndarray]]:
    """A few pictures of the film, and who is in them."""
    pictures = [frame.rgb for frame in open_source(film).frames()][:FRAMES]
    masks = sorted((film / "masks").iterdir())
    return [
        (rgb, np.asarray(Image.open(mask).convert("L")))
        for rgb, mask in zip(pictures, masks, strict=False)
    ]


@pytest.fixture
def folder(film, shots, tmp_path):
    """Writes a capture folder of pictures; each kind of mask shows another part of the person."""

    def write(kinds: list[str], *, beside: bool) -> Path:
        """A folder whose pictures have an alpha channel of these kinds, one a picture."""
        (tmp_path / "images").mkdir()
        (tmp_path / "mine").mkdir()
        if beside:
            (tmp_path / "masks").mkdir()
        for name in ("poses.npz", "cameras.npz"):
            shutil.copy(film / name, tmp_path)
        for index, ((rgb, mask), kind) in enumerate(zip(shots, kinds, strict=True)):
            alpha = upper(mask) if kind == "informative" else np.full_like(mask, 255)
            picture = rgb if kind == "none" else np.dstack([rgb, alpha])
            name = f"{index:04d}.png"
            Image.fromarray(picture).save(tmp_path / "images" / name)
            Image.fromarray(lower(mask)).save(tmp_path / "mine" / name)
            if beside:
                Image.fromarray(mask).save(tmp_path / "masks" / name)
        return tmp_path

    return write


def upper(mask):
    """The upper half of what it shows."""
    half = mask.copy()
    half[32:] = 0
    return half


def lower(mask):
    """The lower half of it."""
    half = mask.copy()
    half[:32] = 0
    return half


def wanted(folder, given):
    masks = {"given": folder / "mine", "segmenter": Path("segmenter:blazepose")}.get(given)
    return CaptureInputs(video=folder, masks=masks)


def parts_shown(recording):
    """Which halves of the person the masks show, frame by frame; None of frames left out."""
    return [
        (bool((item.alpha[:32] > 0.5).any()), bool((item.alpha[32:] > 0.5).any()))
        if isinstance(item, Observation)
        else None
        for item in recording.observations()
    ]


@pytest.mark.parametrize("masks", ["none", "beside", "given", "given, beside", "segmenter"])
@pytest.mark.parametrize("alpha", ["none", "opaque", "informative"])
def test_the_masks_that_are_used(folder, alpha, masks):
    expected, shown = {
        "none": (ALPHA, (True, False)) if alpha == "informative" else (ESTIMATED, (True, True)),
        "beside": ("masks", (True, True)),
        "given": ("mine", (False, True)),
        "given, beside": ("mine", (False, True)),
        "segmenter": (ESTIMATED, (True, True)),
    }[masks]
    there = folder([alpha] * FRAMES, beside="beside" in masks)
    recording = open_capture(wanted(there, masks.split(",", maxsplit=1)[0]), skip_checks=True)
    found = parts_shown(recording)
    assert found == [shown] * FRAMES
    assert recording.mask_report()["masks"] == expected  # after the frames, as the report does
    assert any("estimated" in note for note in recording.notes) == (expected == ESTIMATED)
    assert any("alpha channel" in note for note in recording.notes) == (expected == ALPHA)
    assert not recording.source.warnings


def test_one_opaque_picture_at_the_start_does_not_decide(folder):
    there = folder(["opaque", "informative", "none", "informative"], beside=False)
    recording = open_capture(wanted(there, "none"))
    assert parts_shown(recording) == [None, (True, False), None, (True, False)]
    assert recording.mask_report()["masks"] == ALPHA
