"""What a fit changes, and that a resumed run reads it again."""

from dataclasses import replace

import numpy as np
import pytest

from preprocess.capture_session import CaptureFit, load_capture_fit


@pytest.fixture
def fit() -> CaptureFit:
    corrections = np.zeros((4, 75))
    corrections[:, 0] = 0.1
    return CaptureFit(
        coefficients=np.arange(3.0), focal_factor=1.05, corrections=corrections,
        error_before_cm=1.6, error_after_cm=0.7, share=0.9, keypoint_share=0.0,
        fits_body=False,
    )  # fmt: skip


def test_a_fit_is_read_as_it_was_written(fit, tmp_path):
    fit.save(tmp_path / "fit.npz", "/a/video.mp4")
    read = load_capture_fit(tmp_path / "fit.npz", "/a/video.mp4")
    assert read is not None
    assert np.array_equal(read.corrections, fit.corrections)
    assert read.as_json() == fit.as_json()
    assert read.fits_body is False


def test_the_fit_of_another_video_is_not_taken(fit, tmp_path):
    fit.save(tmp_path / "fit.npz", "/a/video.mp4")
    assert load_capture_fit(tmp_path / "fit.npz", "/another/video.mp4") is None
    assert load_capture_fit(tmp_path / "none.npz", "/a/video.mp4") is None
    (tmp_path / "fit.npz").write_bytes(b"damaged")
    assert load_capture_fit(tmp_path / "fit.npz", "/a/video.mp4") is None


def test_the_description_names_quantities_and_units_and_key_points_where_they_count(fit):
    assert "1.6 cm" in fit.describe()
    assert "5.7 degrees" in fit.describe()
    assert "key points" not in fit.describe()
    assert "count by 60%" in replace(fit, keypoint_share=0.4).describe()
