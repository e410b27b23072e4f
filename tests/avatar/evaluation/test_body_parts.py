"""Body parts of pixels, and their scores."""

import numpy as np
import pytest

from avatar.evaluation.image_metrics import silhouette_of
from avatar.evaluation.skin_patches import SCORED_PARTS, SkinPatches, label_parts, psnr_by_part


def test_each_pixel_has_the_part_that_is_there(shaped, observed):
    observation = observed()
    labels = label_parts(SkinPatches.from_shaped_body(shaped), shaped, observation)
    rows, _ = np.nonzero(silhouette_of(observation))
    order = [
        np.median(rows[labels == SCORED_PARTS.index(name)]) for name in ("head", "trunk", "legs")
    ]
    assert order == sorted(order)
    assert set(np.unique(labels)) == set(range(len(SCORED_PARTS)))
    errors = np.zeros((*observation.alpha.shape, 3))
    errors[rows.max() - 2 :] = 0.01
    found = psnr_by_part(errors, observation, labels)
    assert set(found) == {f"psnr_{name}" for name in SCORED_PARTS}
    assert found["psnr_head"] == np.inf
    assert 20.0 < found["psnr_legs"] < 60.0
    assert psnr_by_part(errors, observation, None) == {}
    errors[:] = 0.01
    assert psnr_by_part(errors, observation, labels) == pytest.approx(dict.fromkeys(found, 20.0))
