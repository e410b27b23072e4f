"""The report: numbers for machines, a page that needs nothing else, and the body map."""

import json
import re
from dataclasses import is_dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args, get_type_hints
from xml.etree import ElementTree

import numpy as np
import pytest

from avatar.evaluation.all_round_verdict import AllRoundVerdict
from avatar.evaluation.coverage import Coverage, VisibilityStage
from avatar.events import HeldOutScore
from instant_avatar.cli.shared_options import capture_name
from instant_avatar.report.page_rendering import data_uri, encode_webp, webp_data_uri
from instant_avatar.report.report_page import ComparisonPair, CoverageMap, report_page
from instant_avatar.report.report_schema import (
    CurvePoint,
    EarlierVideoStats,
    FrameStats,
    HeldOutStats,
    MachineInfo,
    Percentiles,
    Report,
    StreamStats,
    TrainingStats,
)
from instant_avatar.report.report_writer import describe_verdict, diagnose_failure
from preprocess.observation import DroppedFrame
from tests.instant_avatar.browser import Browser, until, with_chromium


def point(seconds, psnr, psnr_mask=None):
    return CurvePoint(
        wall_seconds=seconds, cpu_seconds=seconds, frames_seen=9, psnr=psnr, psnr_mask=psnr_mask
    )


def report(**changes):
    content = {
        "command": {"video": "a <b> & c.mp4"},
        "recipe": {"rays": 1024, "finest_m": 0.0081234567},
        "machine": MachineInfo(threads=2),
        "frames": FrameStats(
            read=20,
            used=17,
            held_out=2,
            dropped=(DroppedFrame(index=7, reason="pose invalid"),),
            near_duplicates=0,
            not_replayed=0,
        ),
        "training": TrainingStats(
            wall_seconds=60.0,
            step_cpu_seconds=1.0,
            cpu_seconds=61.0,
            startup_seconds=3.0,
            steps=100,
            rays=102400,
            rays_per_second=1706.7,
            samples_per_ray=7.0,
            peak_memory_mb=900.0,
        ),
        "held_out": HeldOutStats.of((), None),
        "curve": (point(2.0, 24.0, 18.0), point(5.0, 29.0, 23.0)),
        "stream": StreamStats(
            realtime=False,
            ingest_ms=Percentiles(p50=20.0, p95=30.0),
            inbox_dropped=0,
            ready_after_last_frame_seconds=None,
            latency_ms=Percentiles(p50=25.0, p95=40.0),
            lateness_ms=Percentiles(p50=0.0, p95=1.0),
            inbox_depth=Percentiles(p50=0.0, p95=2.0),
        ),
        "package": None,
        "all_round": judged(None),
    }
    return Report(**{**content, **changes})


def judged(held_out):
    return AllRoundVerdict.of(
        held_out,
        seen=0.99,
        mean_cosine=0.91,
        half_transparent=0.08,
        player_psnr=44.0,
        film_advice="Turn.",
    )


def scores(*values):
    return tuple(
        HeldOutScore(frame=9 + 10 * i, psnr=psnr, psnr_mask=mask, ssim=0.9)
        for i, (psnr, mask) in enumerate(values)
    )


def test_frames_of_one_cause_are_counted_once_whatever_each_adds():
    lost = ("mask unusable: none for 3", "mask unusable: none for 4", "pose invalid")
    dropped = tuple(DroppedFrame(index=n, reason=reason) for n, reason in enumerate(lost))
    frames = replace(report().frames, used=15, dropped=dropped)
    told = "3 left out (2 with no mask or an unusable one, 1 without a pose)."
    assert frames.sentence().endswith(told)


def test_a_frame_without_a_person_has_no_masked_score():
    note = HeldOutStats.of(scores((30.0, 20.0), (32.0, float("nan"))), (64, 48))
    assert (note.psnr, note.psnr_mask) == (31.0, 20.0)
    assert note.frames == (9, 19)


def test_what_there_is_not_and_what_is_no_number_is_null():
    text = report(curve=(point(2.0, float("nan"), float("inf")),)).to_json()
    content = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert (content["held_out"]["psnr"], content["held_out"]["frames"]) == (None, [])
    assert (content["package"], content["held_out_refined"]) == (None, None)
    assert (content["curve"][0]["psnr"], content["curve"][0]["psnr_mask"]) == (None, None)


class Tags(HTMLParser):
    """Checks that tags close in order, and collects addresses."""

    VOID = ("meta", "img", "br")

    def __init__(self, page):
        super().__init__()
        self.open, self.addresses = [], []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_asks_for_no_other_file():
    white = webp_data_uri(np.full((4, 4, 3), 255, np.uint8))
    earlier = EarlierVideoStats(
        videos=("first <1>.mp4",), frames_trained=54, wall_seconds=30.0, replayed_key_frames=40
    )
    page = report_page(
        report(earlier_videos=earlier),
        name="a <b> & c.mp4",
        verdict="Sharp, <b>.",
        pairs=[ComparisonPair(frame=9, psnr=22.78, verdict="blurred", truth=white, render=white)],
        animation=data_uri(encode_webp([np.zeros((4, 4, 4), np.uint8)] * 3, fps=10.0)),
        warnings=["masks <turned>"],
        notes=["masks refined"],
    )
    tags = Tags(page)
    assert len(tags.addresses) == 3
    assert all(address.startswith("data:image/webp;base64,") for address in tags.addresses)
    assert "a &lt;b&gt; &amp; c.mp4" in page
    assert "first &lt;1&gt;.mp4" in page
    assert "40 key frames" in page
    assert "22.78 dB (blurred)" in page
    folded = page.index("<summary>Notes</summary>")
    assert page.index("masks &lt;turned&gt;") < folded < page.index("masks refined")
    assert page.index("turning and dancing") < page.index("<h2>Numbers</h2>") < folded
    assert "url(" not in page
    assert 'tabindex="0"' in page  # a click enlarges a pair, by its focus alone


def test_a_page_without_pictures_or_scores_is_whole_too():
    page = report_page(report(curve=()), name="clip", verdict="Sharp.")
    assert Tags(page).addresses == []
    assert "<svg" not in page


def failed(*, steps, video="my clip.mp4", overlap=0.9):
    note = replace(
        HeldOutStats.of(scores((6.88, 6.0)), (64, 48)), verdict="failed", overlap=overlap
    )
    given = report()
    return replace(
        given,
        held_out=note,
        all_round=judged("failed"),
        training=replace(given.training, steps=steps),
        command={"video": video, "poses": "p.npz", "masks": None, "cameras": "solve"},
    )


def test_a_failure_names_what_was_seen_and_what_to_do():
    room = diagnose_failure(failed(steps=900, overlap=0.2))
    assert "6.88 dB (failed)" in room
    assert room.endswith("ia-check 'my clip.mp4' --poses p.npz")
    advice = diagnose_failure(failed(steps=26))
    assert "26" in advice
    assert "--steps" in advice
    assert "ia-check" not in diagnose_failure(failed(steps=900, video="camera:0"))
    assert diagnose_failure(report()) is None


def test_a_video_whose_name_says_nothing_is_called_by_its_folder():
    assert capture_name(Path("films/anna/video.MP4")) == "anna"
    assert capture_name(Path("films/anna turning.mov")) == "anna turning"


def test_an_avatar_of_one_side_is_not_called_sharp():
    one_sided = AllRoundVerdict.of(
        "sharp",
        seen=0.45,
        mean_cosine=0.35,
        half_transparent=0.11,
        player_psnr=40.0,
        film_advice="Turn round.",
    )
    kept = replace(report(), all_round=one_sided)
    assert kept.verdict == "blurred"
    assert json.loads(kept.to_json())["all_round"]["limit"] == "filmed"
    verdict = describe_verdict(kept, None, is_final=True)
    assert verdict.startswith("The avatar is blurred. ")
    assert verdict.endswith("Turn round.")
    assert verdict in report_page(kept, name="clip", verdict=verdict)
    assert diagnose_failure(kept) is None


WORDS_IN_TWO_LINES = """
[...document.querySelectorAll(":not(details) > table td, .tile b")].flatMap((cell) => {
  const text = cell.firstChild, range = document.createRange();
  return [...text.data.matchAll(/[0-9.]+ dB|[0-9A-Za-z.]+/g)].filter(({ index, 0: word }) => {
    range.setStart(text, index);
    range.setEnd(text, index + word.length);
    return new Set([...range.getClientRects()].map(({ top }) => top)).size > 1;
  }).map(String);
})
"""
"""Words of tables, and figures, that a page breaks in two."""


@pytest.mark.slow
@with_chromium
def test_a_page_of_360_px_breaks_no_word_and_no_figure(tmp_path):
    parts = [
        {"part": "poses", "name": "poses.npz of unknown origin", "licence": "unknown"},
        {"part": "tracker", "name": "BlazePose, of Google's MediaPipe", "licence": "Apache-2.0"},
    ]
    licence = {"parts": parts, "commercial_use": "unknown", "because": "poses.npz"}
    held_out = HeldOutStats.of(scores((39.14, 30.78)), (64, 48))
    page = report_page(report(licence=licence, held_out=held_out), name="clip", verdict="Sharp.")
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    with Browser(tmp_path / "browser", size=(360, 740)) as browser:
        browser.emulate(scheme="light", size=(360, 740))
        browser.go((tmp_path / "report.html").as_uri())
        until(lambda: "What it was made with" in browser.text(), 60.0)
        assert browser.run(WORDS_IN_TWO_LINES) == []


def test_scores_that_ended_before_the_verdict_are_not_called_missing():
    held_out = HeldOutStats.of(scores((29.75, 25.0)), (64, 48))
    verdict = describe_verdict(report(held_out=held_out), None, is_final=True)
    assert verdict == "The avatar is there. It was not judged from all sides."


def test_the_page_names_no_file_that_is_not_there_and_what_comes_next():
    cameras = {
        "verdict": "solved", "focal_px": 434.2, "scale": {"cues": ["ground"]},
        "frames": {"key": 60, "placed": 28, "interpolated": 2, "missing": 0},
    }  # fmt: skip

    def page(*present, **more):
        solved = report(cameras=cameras)
        return report_page(solved, name="clip", verdict="Sharp.", present_files=present, **more)

    assert "cameras.npz" not in page("cameras.npz")
    both = page("cameras.npz", "poses.npz", next_steps={"Play": "ia-play 'a run/x.iavatar'"})
    assert "poses.npz hold" in both
    assert "ia-play &#39;a run/x.iavatar&#39;" in both


def paths_in(record, above=""):
    """Every key of a record in dots, as in `training.steps`."""
    for name, kind in get_type_hints(record).items():
        yield f"{above}{name}"
        for part in (kind, *get_args(kind)):
            if is_dataclass(part):
                yield from paths_in(part, f"{above}{name}.")


def test_the_page_on_the_report_names_every_key_and_no_other():
    page = (Path(__file__).parents[3] / "docs" / "report.md").read_text()
    told = set(re.findall(r"`([a-z0-9_.]+)`", page))
    free = {
        "command",
        "recipe",
        "cameras",
        "tracking",
        "licence",
    }  # what is in these, no record says
    paths = {path for path in paths_in(Report) if path.split(".")[0] not in free} | free
    above = {path.split(".")[0] for path in told}
    alike = {path: path.replace("held_out_refined.", "held_out.") for path in paths}
    known = told | above
    assert not [p for p, like in alike.items() if not {like, like.split(".")[-1]} & known]
    dotted = {
        path
        for path in told
        if "." in path and path.split(".")[0] not in {"report", "turning", *free}
    }
    assert len(dotted) > 20
    assert dotted <= paths


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


def test_the_persons_left_front_is_on_the_right_of_the_first_view_and_missing_in_the_third(
    body_map, coverage
):
    patches = coverage.patches
    see(coverage, (patches.normals[:, 2] > 0.0) & (patches.points[:, 0] > 0.05), 1.0)
    svg = body_map.svg()
    found, texts = dots(svg), ElementTree.fromstring(svg).findall("text")
    assert [text.text for text in texts] == ["front", "left", "back", "right"]

    def share_well(view: int, low: float, high: float) -> float:
        """Share of well seen skin among the dots between two columns of a view."""
        well, never = (
            np.count_nonzero((places > low) & (places < high))
            for places in (
                found[kind][:, 0] - float(texts[view].get("x")) for kind in ("well", "never")
            )
        )
        return well / (well + never)

    assert share_well(0, 10.0, 50.0) > 0.95
    assert share_well(0, -50.0, -2.0) == 0.0
    assert share_well(1, -10.0, 10.0) > 0.2
    assert share_well(2, -50.0, 50.0) < 0.05
    assert share_well(3, -50.0, 50.0) < 0.05
