"""report.html: one page without a second file, that shows what report.json says."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files
from typing import Any

from apps.report.learning_curve import CurvePoint, curve_svg, largest_drops
from apps.report.report_schema import Report, format_percent, format_psnr


@dataclass(frozen=True, kw_only=True)
class ComparisonPair:
    """A held-out frame: what the video shows, and what the avatar shows.

    Attributes:
        frame: Its number in the video.
        psnr: Of the whole picture, dB.
        verdict: What that means, in a word.
        truth, render: Pictures as addresses.
    """

    frame: int
    psnr: float
    verdict: str | None
    truth: str
    render: str


def report_page(
    report: Report,
    *,
    name: str,
    body_map: str = "",
    pairs: Sequence[ComparisonPair] = (),
    animation: str | None = None,
    warnings: Sequence[str] = (),
    failure: str | None = None,
    present_files: Collection[str] = (),
    play_command: str | None = None,
) -> str:
    """The page.

    Args:
        report: The figures.
        name: Of the video, for the heading.
        body_map: An SVG of what was seen (`CoverageMap.svg`).
        pairs: Held-out frames, to look at.
        novel: A moving picture of poses that the video does not show, as an address.
        warnings: What the user was told.
        failure: Why the result is no avatar of the person, if it is none.
        present: Names of what lies beside the page; nothing else is named as being there.
        play: The command that plays the package, if there is one.
    """
    playing = (
        "" if play_command is None else f" Play the avatar: <code>{escape(play_command)}</code>"
    )
    style = (files("apps") / "report" / "page.css").read_text(encoding="utf-8")
    body = "\n".join(
        [
            f"<h1>{escape(name)}</h1>",
            f'<p class="lead">{escape(_summary(report))}</p>',
            f'<p class="failure">{escape(failure)}</p>' if failure else "",
            _tiles(report),
            _section("How it learnt", _curve(report)),
            _section("The video before", _earlier_videos(report)),
            _section("What the camera has seen", _coverage(report, body_map)),
            _section("Where the camera was", _cameras(report, present_files)),
            _section("Frames it was never trained on", _pairs(pairs)),
            _section("Poses that the video does not show", _animation(animation)),
            _section("Worth knowing", _warnings(report, warnings)),
            _section("All figures", _all_values(report)),
            "<footer>Written by ia-ingest of instant-avatar-stream. The same figures for machines: "
            f"report.json.{playing}</footer>",
        ]
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(name)}: avatar</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _summary(report: Report) -> str:
    training, machine = report.training, report.machine
    threads = "one thread" if machine.threads == 1 else f"{machine.threads} threads"
    where = f"a CPU, {threads}" if machine.device == "cpu" else "a GPU"
    earlier, learnt = report.earlier_videos, f"{training.wall_seconds:.0f} seconds"
    frames = f"{report.frames.used} frames"
    if earlier is not None:
        frames += (
            f" of this video, and {earlier.frames_trained} of {_join_names(earlier.videos)} before"
        )
        now_s = training.wall_seconds - earlier.wall_seconds
        learnt += f" ({now_s:.0f} on this video)"
    return f"An avatar from {frames}, learnt in {learnt} on {where}."


def _join_names(names: Sequence[str]) -> str:
    return " and ".join(names) or "an earlier video"


def _earlier_videos(report: Report) -> str:
    """Two sentences, if the video was added to an avatar."""
    earlier = report.earlier_videos
    if earlier is None:
        return ""
    told = f"{earlier.replayed_key_frames} frames of {_join_names(earlier.videos)} were learnt from again. "
    if earlier.psnr_before is None or earlier.psnr_after is None or earlier.largest_drop is None:
        told += "None of its frames had been held out, so what it lost cannot be said."
    else:
        told += (
            f"Held-out frames there ({len(earlier.frames)}): {earlier.psnr_before:.2f} dB before "
            f"this video, {earlier.psnr_after:.2f} dB now; none of them lost more than "
            f"{earlier.largest_drop:.2f} dB."
        )
    return f'<p class="legend">{escape(told)}</p>'


def _tiles(report: Report) -> str:
    held, package = report.held_out, report.package
    tiles = [
        (report.verdict or "not scored", "how it looks"),
        (_format_value(held.psnr, "dB"), _with_verdict("held-out PSNR, on white", held.verdict)),
        (_format_value(held.psnr_mask, "dB"), "inside the mask"),
        (_format_value(held.ssim, "", digits=3), "SSIM"),
        (f"{report.training.steps:,}", "steps"),
        (f"{report.training.rays_per_second / 1000.0:,.0f} k", "rays a second"),
        (f"{package.bytes / 1e6:.1f} MB" if package else "none", "package"),
    ]
    cells = (
        f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles
    )
    return f'<div class="tiles">{"".join(cells)}</div>'


def _with_verdict(label: str, verdict: str | None) -> str:
    return f"{label}: {verdict}" if verdict else label


def _format_value(value: float | None, unit: str, *, digits: int = 2) -> str:
    return "n/a" if value is None else f"{value:.{digits}f} {unit}".strip()


def _section(heading: str, content: str) -> str:
    return f"<h2>{heading}</h2>\n{content}" if content else ""


def _curve(report: Report) -> str:
    svg = curve_svg(report.curve)
    if not svg:
        return ""
    return (
        f'<div class="card">{svg}<p class="legend">Mean PSNR of the held-out frames so far'
        '<i style="background:var(--whole)"></i>whole picture'
        '<i style="background:var(--masked)"></i>inside the mask. '
        f"{_curve_caption(report.curve)}</p></div>"
    )


def _curve_caption(curve: Sequence[CurvePoint]) -> str:
    """How the frames themselves fared, where marks are means over different frames."""
    scored = [len(point.frames) for point in curve if point.frames]
    falls = largest_drops(curve)
    told = ""
    sets = {(p.video, tuple(number for number, _ in p.frames)) for p in curve if p.frames}
    if len(sets) > len({video for video, _ in sets}):
        told = (
            f"Marks are means over different frames ({min(scored)} to {max(scored)} of them), so "
            "the line can fall where no frame does. "
        )
    if falls:
        were = "was" if len(falls) == 1 else "were"
        told += (
            f"Of the held-out frames, {len(falls)} {were} scored more than once; none was at any "
            f"later mark more than {max(falls.values()):.1f} dB below its own best."
        )
    elif scored:
        told += "No frame was scored more than once, so whether one got worse cannot be said."
    return told


def _cameras(report: Report, present: Collection[str]) -> str:
    """A sentence, if cameras were to be solved."""
    found = report.cameras
    if found is None:
        return ""
    told = {
        "still": "The camera stood still; there was nothing to solve.",
        "stopped": "Solving was stopped; the same command with --resume goes on.",
        "refused": found.get("reason", ""),
    }.get(found["verdict"])
    if told is None:
        frames, scale = found["frames"], found["scale"]
        told = (
            f"Solved from {frames['key']} key frames; {frames['placed']} were placed between "
            f"them, {frames['interpolated']} interpolated, {frames['missing']} are missing. Focal "
            f"length {found['focal_px']:.0f} px; the size of the room is told by "
            f"{' and '.join(scale['cues'])}."
        )
        if {"cameras.npz", "poses.npz"} <= set(present):
            told += " cameras.npz and poses.npz hold the cameras and the poses in their world."
    return f'<p class="legend">{escape(told)}</p>'


def _coverage(report: Report, body_map: str) -> str:
    """The sentence, the map, and every part and side in figures."""
    note = report.coverage
    if note is None:
        return ""
    rows = "".join(
        f"<tr><td>{escape(part)}</td><td>{format_percent(shares['seen'])}</td><td>{_by_side(shares)}</td></tr>"
        for part, shares in note.parts.items()
    )
    return (
        f'<div class="card"><p class="advice">{escape(note.advice)}</p>{body_map}'
        f'<p class="legend">{format_percent(note.seen)} of the skin seen'
        '<i style="background:var(--whole)"></i>well'
        '<i style="background:var(--whole);opacity:0.4"></i>at a slant'
        '<i style="background:var(--masked)"></i>never. Left and right are the person\'s.</p>'
        f"<details><summary>Part by part</summary><table>{rows}</table></details></div>"
    )


def _by_side(shares: Mapping[str, float]) -> str:
    sides = (f"{side} {format_percent(share)}" for side, share in shares.items() if side != "seen")
    return ", ".join(sides)


def _pairs(pairs: Sequence[ComparisonPair]) -> str:
    figures = (
        f'<figure><div class="two"><img src="{pair.truth}" alt="frame {pair.frame} of the video">'
        f'<img src="{pair.render}" alt="frame {pair.frame} rendered"></div>'
        f"<figcaption>frame {pair.frame}: video | avatar, "
        f"{escape(format_psnr(pair.psnr, pair.verdict))}</figcaption></figure>"
        for pair in pairs
    )
    return f'<div class="pairs">{"".join(figures)}</div>' if pairs else ""


def _animation(novel: str | None) -> str:
    if novel is None:
        return ""
    return (
        f'<figure class="novel"><img src="{novel}" alt="the avatar in poses of its own">'
        "<figcaption>Drawn by the player, from the package</figcaption></figure>"
    )


def _warnings(report: Report, warnings: Sequence[str]) -> str:
    told = list(warnings)
    reasons: dict[str, list[int]] = {}
    for drop in report.frames.dropped:
        reasons.setdefault(drop.reason, []).append(drop.index)
    told = [w for w in told if not w.startswith("Frame ")]
    for reason, frames in reasons.items():
        told.append(f"Left out, {reason}: frame {', '.join(str(frame) for frame in frames)}.")
    items = "".join(f"<li>{escape(message)}</li>" for message in told)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _all_values(report: Report) -> str:
    content = asdict(report)
    shown = ("frames", "training", "held_out", "stream", "package", "machine")
    tables = [f'<div class="card"><table>{_rows({key: content[key] for key in shown})}</table>']
    for key, heading in (("recipe", "The recipe"), ("command", "The command")):
        rows = _rows(content[key])
        tables.append(f"<details><summary>{heading}</summary><table>{rows}</table></details>")
    return "".join(tables) + "</div>"


def _rows(content: Mapping[str, Any]) -> str:
    return "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>"
        for name, value in _flatten(content)
    )


def _flatten(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Names with dots and what they hold, in words; lists of records are left out."""
    for key, value in content.items():
        name = f"{before}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{before}{key}.")
        elif isinstance(value, list | tuple):
            if not (value and isinstance(value[0], Mapping)):
                yield name, ", ".join(str(item) for item in value) or "none"
        elif isinstance(value, float):
            yield name, f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
        else:
            yield name, "n/a" if value is None else str(value)
