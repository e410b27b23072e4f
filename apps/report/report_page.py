"""report.html, and parts of self-contained pages: head with style, sections, tables, images."""

import base64
import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from apps.report.report_figures import CurvePoint, curve_svg, largest_drops
from apps.report.report_schema import Report, format_percent, format_psnr


def html_page(title: str, body: str, *, style: str = "") -> str:
    """Return a whole page in the style of page.css.

    Args:
        title: Plain text.
        body: HTML.
        style: More rules of CSS.
    """
    style = (files("apps") / "report" / "page.css").read_text(encoding="utf-8") + style
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def html_section(heading: str, content: str) -> str:
    """Return content under a heading; nothing without content."""
    return f"<h2>{heading}</h2>\n{content}" if content else ""


def html_note(text: str) -> str:
    """Return a small paragraph of plain text; nothing without text."""
    return f'<p class="legend">{escape(text)}</p>' if text else ""


def html_table(lines: Sequence[Sequence[str]], *, header: bool = True) -> str:
    """Return lines of plain cells as a table; nothing without lines below the header.

    Args:
        lines: Cells of each line.
        header: Whether the first line is the header.
    """
    if len(lines) <= header:
        return ""
    rows = ["".join(f"<td>{escape(cell)}</td>" for cell in line) for line in lines]
    if header:
        rows[0] = rows[0].replace("td>", "th>")
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Round an image in [0, 1] to 8 bits."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """Encode an RGB or RGBA image as a data URI."""
    return data_uri(encode_webp([picture], fps=1.0))


def data_uri(webp: bytes) -> str:
    """Return the content of a WebP file as a data URI."""
    return "data:image/webp;base64," + base64.b64encode(webp).decode("ascii")


def encode_webp(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> bytes:
    """Encode RGB or RGBA images as WebP; several are a looping animation."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    frame_ms, buffer = max(1, round(1000.0 / fps)), io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(buffer, format="WEBP", quality=82, method=3, **(moving if others else {}))
    return buffer.getvalue()


@dataclass(frozen=True, kw_only=True)
class ComparisonPair:
    """A held-out frame and its rendering.

    Attributes:
        frame: Frame number in the video.
        psnr: PSNR of the whole image, dB.
        verdict: Verdict on the frame.
        truth: The video's image as a data URI.
        render: The avatar's rendering as a data URI.
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
    """Return the page as HTML.

    Args:
        report: The values to show.
        name: Name of the video, for the heading.
        body_map: SVG of the body coverage (`CoverageMap.svg`).
        pairs: Held-out frames and their renderings.
        animation: Animation of novel poses as a data URI.
        warnings: Warnings shown to the user.
        failure: Why the avatar has failed, if it has.
        present_files: Names of the files next to the page; the page refers to no others.
        play_command: Command that plays the package, if there is one.
    """
    playing = (
        "" if play_command is None else f" Play the avatar: <code>{escape(play_command)}</code>"
    )
    body = "\n".join(
        [
            f"<h1>{escape(name)}</h1>",
            f'<p class="lead">{escape(_summary(report))}</p>',
            f'<p class="failure">{escape(failure)}</p>' if failure else "",
            f'<p class="advice">{escape(report.all_round.advice)}</p>'
            if report.all_round.advice
            else "",
            _tiles(report),
            html_section("Learning curve", _curve(report)),
            html_section("Earlier videos", _earlier_videos(report)),
            html_section("Body coverage", _coverage(report, body_map)),
            html_section("Cameras", _cameras(report, present_files)),
            html_section("Tracking", _tracking(report)),
            html_section("Held-out frames", _pairs(pairs)),
            html_section("Novel poses", _animation(animation)),
            html_section("Warnings", _warnings(report, warnings)),
            html_section("All values", _all_values(report)),
            "<footer>Written by ia-ingest of instant-avatar-stream. Machine-readable: report.json."
            f"{playing}</footer>",
        ]
    )
    return html_page(f"{name}: avatar", body)


def _summary(report: Report) -> str:
    training, machine = report.training, report.machine
    threads = "one thread" if machine.threads == 1 else f"{machine.threads} threads"
    earlier, duration = report.earlier_videos, f"{training.wall_seconds:.0f} seconds"
    frames = f"{report.frames.used} frames"
    if earlier is not None:
        frames += f" of this video, and {earlier.frames_trained} of {_join_names(earlier.videos)}"
        now_s = training.wall_seconds - earlier.wall_seconds
        duration += f" ({now_s:.0f} on this video)"
    return f"An avatar from {frames}, trained for {duration} on a CPU, {threads}."


def _join_names(names: Sequence[str]) -> str:
    return " and ".join(names) or "an earlier video"


def _earlier_videos(report: Report) -> str:
    """Describe replay and forgetting, if the video was added to an avatar."""
    earlier = report.earlier_videos
    if earlier is None:
        return ""
    videos = _join_names(earlier.videos)
    text = f"{earlier.replayed_key_frames} key frames of {videos} were replayed. "
    if earlier.psnr_before is None or earlier.psnr_after is None or earlier.largest_drop is None:
        text += "None of its frames had been held out, so forgetting could not be measured."
    else:
        text += (
            f"PSNR of its {len(earlier.frames)} held-out frames: {earlier.psnr_before:.2f} dB "
            f"before this video, {earlier.psnr_after:.2f} dB now (largest drop "
            f"{earlier.largest_drop:.2f} dB)."
        )
    return html_note(text)


def _tiles(report: Report) -> str:
    held, package = report.held_out, report.package
    tiles = [
        (report.verdict or "not scored", "verdict, from all sides"),
        (_format_value(held.psnr, "dB"), _with_verdict("held-out PSNR, on white", held.verdict)),
        (_format_value(held.psnr_mask, "dB"), "PSNR inside mask"),
        (_format_value(held.ssim, "", digits=3), "SSIM"),
        (f"{report.training.steps:,}", "steps"),
        (f"{report.training.rays_per_second / 1000.0:,.0f} k", "rays/s"),
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


def _curve(report: Report) -> str:
    svg = curve_svg(report.curve)
    if not svg:
        return ""
    return (
        f'<div class="card">{svg}<p class="legend">Mean PSNR of the held-out frames'
        '<i style="background:var(--whole)"></i>whole image'
        '<i style="background:var(--masked)"></i>inside the mask. '
        f"{_curve_caption(report.curve)}</p></div>"
    )


def _curve_caption(curve: Sequence[CurvePoint]) -> str:
    """Describe the drops of single frames, as points may average different frames."""
    scored = [len(point.frames) for point in curve if point.frames]
    drops = largest_drops(curve)
    text = ""
    sets = {(p.video, frozenset(number for number, _ in p.frames)) for p in curve if p.frames}
    if len(sets) > len({video for video, _ in sets}):
        text = (
            f"Points average different sets of frames ({min(scored)} to {max(scored)}), so the "
            "curve can drop although no frame got worse. "
        )
    if drops:
        frames = "frame was" if len(drops) == 1 else "frames were"
        text += (
            f"{len(drops)} held-out {frames} scored repeatedly; the largest drop from a frame's "
            f"best is {max(drops.values()):.1f} dB."
        )
    elif scored:
        text += "No frame was scored repeatedly, so drops could not be measured."
    return text


def _cameras(report: Report, present: Collection[str]) -> str:
    """Describe the solved cameras, if any were requested."""
    found = report.cameras
    if found is None:
        return ""
    text = {
        "still": "The camera did not move; there was nothing to solve.",
        "stopped": "Solving was stopped; the same command with --resume continues it.",
        "refused": found.get("reason", ""),
    }.get(found["verdict"])
    if text is None:
        frames, scale = found["frames"], found["scale"]
        text = (
            f"Solved from {frames['key']} key frames; {frames['placed']} frames placed between "
            f"them, {frames['interpolated']} interpolated, {frames['missing']} missing. Focal "
            f"length {found['focal_px']:.0f} px; metric scale from: {', '.join(scale['cues'])}."
        )
        if {"cameras.npz", "poses.npz"} <= set(present):
            text += " cameras.npz and poses.npz hold the cameras and the poses in their world."
    return html_note(text)


def _tracking(report: Report) -> str:
    """Grades of poses that were tracked in the video, and where they are doubtful."""
    found = report.tracking
    if found is None:
        return ""
    lines = [
        (f"{each['start_s']:.1f} to {each['end_s']:.1f} s", each["reason"])
        for each in found["doubtful"]
    ]
    return html_note(found["summary"]) + html_table([("doubtful", "why"), *lines])


def _coverage(report: Report, body_map: str) -> str:
    """Advice, coverage map, and the fraction seen of each body part and side."""
    note = report.coverage
    if note is None:
        return ""
    lines = [
        (part, format_percent(shares["seen"]), _by_side(shares))
        for part, shares in note.parts.items()
    ]
    return (
        f'<div class="card"><p class="advice">{escape(note.advice)}</p>{body_map}'
        f'<p class="legend">{format_percent(note.seen)} of the skin seen'
        '<i style="background:var(--whole)"></i>frontal'
        '<i style="background:var(--whole);opacity:0.4"></i>grazing'
        '<i style="background:var(--masked)"></i>unseen. Left and right are the person\'s.</p>'
        f"<details><summary>By body part</summary>{html_table(lines, header=False)}</details></div>"
    )


def _by_side(shares: Mapping[str, float]) -> str:
    sides = (f"{side} {format_percent(share)}" for side, share in shares.items() if side != "seen")
    return ", ".join(sides)


def _pairs(pairs: Sequence[ComparisonPair]) -> str:
    figures = (
        f'<figure tabindex="0"><div class="two"><img src="{pair.truth}" '
        f'alt="frame {pair.frame} of the video">'
        f'<img src="{pair.render}" alt="frame {pair.frame} rendered"></div>'
        f"<figcaption>frame {pair.frame}: video | avatar, "
        f"{escape(format_psnr(pair.psnr, pair.verdict))}</figcaption></figure>"
        for pair in pairs
    )
    told = html_note("Click a pair to enlarge it, and beside it to go back.")
    return f'<div class="pairs">{"".join(figures)}</div>{told}' if pairs else ""


def _animation(data_uri: str | None) -> str:
    if data_uri is None:
        return ""
    return (
        f'<figure class="novel"><img src="{data_uri}" alt="the avatar in novel poses">'
        "<figcaption>Rendered by the player from the package</figcaption></figure>"
    )


def _warnings(report: Report, warnings: Sequence[str]) -> str:
    messages = [warning for warning in warnings if not warning.startswith("Frame ")]
    reasons: dict[str, list[int]] = {}
    for drop in report.frames.dropped:
        reasons.setdefault(drop.reason, []).append(drop.index)
    for reason, frames in reasons.items():
        messages.append(f"Skipped, {reason}: frame {', '.join(str(frame) for frame in frames)}.")
    items = "".join(f"<li>{escape(message)}</li>" for message in messages)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _all_values(report: Report) -> str:
    content = asdict(report)
    shown = ("frames", "training", "held_out", "stream", "package", "machine")
    parts = [_values({key: content[key] for key in shown})]
    for key, heading in (("recipe", "Configuration"), ("command", "Command")):
        parts.append(f"<details><summary>{heading}</summary>{_values(content[key])}</details>")
    return f'<div class="card">{"".join(parts)}</div>'


def _values(content: Mapping[str, Any]) -> str:
    return html_table(list(_flatten(content)), header=False)


def _flatten(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Yield dotted names and formatted values; lists of records are skipped."""
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
