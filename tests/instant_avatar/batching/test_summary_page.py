"""The contact sheet of a batch: the worst first."""

import pytest

from instant_avatar.batching.summary_page import summary_page


@pytest.fixture
def results(named, ended):
    """Two avatars, a refused capture, and one that waits."""
    ends = {"good": (0, 35.0), "blurred": (0, 25.0), "b<d": (2,)}
    made = {name: ended(named(name), *end).record for name, end in ends.items()}
    return {**made, "new": None}


def test_the_page_shows_avatars_and_causes_the_worst_first(results):
    page = summary_page(results, "avatars")
    names = ["b&lt;d", "new", "blurred", "good"]
    places = [page.index(f"<b>{name}</b>") for name in names]
    assert places == sorted(places)
    assert 'src="good/turning.webp"' in page
    assert 'href="_failed/b%3Cd/ingest.log"' in page
    assert "no &lt;person&gt;" in page
    assert "no <person>" not in page
    assert "--paper" in page  # the style of all pages
