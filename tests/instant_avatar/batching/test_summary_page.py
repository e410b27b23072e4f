"""The contact sheet of a batch: the worst first."""

import pytest

from instant_avatar.batching.summary_page import headline, summary_page


@pytest.fixture
def results(named, ended):
    """Two avatars, a refused capture, and one that waits."""
    ends = {"good": (0, 35.0), "blurred": (0, 25.0), "b<d": (2,)}
    made = {name: ended(named(name), *end).record for name, end in ends.items()}
    return {**made, "new": None}


def test_counts_and_medians_are_said_in_a_sentence(results):
    assert headline(results) == "2 done, 1 waiting, 1 refused. Median 30.00 dB, 60 s."
    assert headline({"new": None}) == "1 waiting."


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
