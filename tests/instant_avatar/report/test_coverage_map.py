"""The map of the body: dots whose color says what was seen."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from avatar.evaluation.coverage import Coverage, VisibilityStage
from instant_avatar.report.report_figures import CoverageMap


@pytest.fixture(scope="module")
def coverage(shaped) -> Coverage:
    return Coverage(shaped)


@pytest.fixture(scope="module")
def body_map(shaped, coverage) -> CoverageMap:
    return CoverageMap(shaped, coverage)


def see(coverage: Coverage, where: np.ndarray, cosine: float) -> None:
    coverage.cosines[:] = np.where(where, cosine, 0.0)
    coverage.stages[:] = np.where(where, VisibilityStage.SEEN, VisibilityStage.FACING_AWAY)


def dots(svg: str) -> dict[str, np.ndarray]:
    """Places of the dots of each class."""
    found = {"never": [], "slant": [], "well": []}
    for path in ElementTree.fromstring(svg).findall("path"):
        pairs = re.findall(r"M(-?[\d.]+) (-?[\d.]+)h0", path.get("d"))
        found[path.get("class")] += [[float(x), float(y)] for x, y in pairs]
    return {kind: np.array(places).reshape(-1, 2) for kind, places in found.items()}


def test_an_unseen_body_has_one_kind_of_dots_and_a_seen_one_another(body_map, coverage):
    everywhere = np.ones(len(coverage.cosines), dtype=bool)
    counts = {}
    for kind, cosine in (("never", 0.0), ("slant", 0.4), ("well", 0.9)):
        see(coverage, everywhere, cosine)
        found = dots(body_map.svg())
        counts[kind] = len(found[kind])
        assert sum(len(places) for places in found.values()) == counts[kind]
    assert counts["never"] == counts["slant"] == counts["well"] > 1000


def test_the_front_is_drawn_first_and_the_back_third(body_map, coverage):
    see(coverage, coverage.patches.normals[:, 2] > 0.0, 1.0)
    found = dots(body_map.svg())
    texts = ElementTree.fromstring(body_map.svg()).findall("text")
    middles = {text.text: float(text.get("x")) for text in texts}
    assert list(middles) == ["front", "left", "back", "right"]

    def share_well(view: str) -> float:
        well, never = (
            np.count_nonzero(np.abs(found[kind][:, 0] - middles[view]) < 10.0)
            for kind in ("well", "never")
        )
        return well / (well + never)

    assert share_well("front") > 0.95
    assert share_well("back") < 0.05
    assert 0.2 < share_well("left") < 0.8


def test_in_front_view_the_persons_left_is_on_the_right(body_map, coverage):
    see(coverage, coverage.patches.points[:, 0] > 0.05, 1.0)
    found = dots(body_map.svg())
    texts = ElementTree.fromstring(body_map.svg()).findall("text")
    front, back = (float(texts[k].get("x")) for k in (0, 2))
    for middle, sign in ((front, 1.0), (back, -1.0)):
        reach = sign * (found["well"][:, 0] - middle)
        here = np.abs(reach) < 50.0
        assert np.all(reach[here] > 0.0)
