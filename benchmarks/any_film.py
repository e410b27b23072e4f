"""Films of people who do not turn: avatars from parts of a turn, scored from all sides.

    python -m benchmarks.any_film [FILM ...] [--subjects N] [--size PX] [--steps N]

Phone-like films of turning actors are cut to their first sixth, third and half, opened as
ia-ingest would, and learnt. Avatars are scored in poses never filmed, from sides that the cut does
not show: against the truth where there is one, by how firm the surface is, and by how near the
player is to the renderer. Films and capture folders of your own get the rows that need no truth.
Held-out frames, which come from the filmed side, are the last row to judge by. Prints one table.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import cv2
import numpy as np
import tyro

from avatar.avatar_model import Avatar
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.evaluation.image_metrics import composite_on_white, psnr
from avatar.evaluation.unfilmed_views import (
    half_transparent_share,
    render_unfilmed_views,
    unfilmed_views,
)
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer, cosine_decay
from baselines.hardware import ROOT, Hardware
from baselines.systems.compared_capture import ComparedCapture
from benchmarks.head_scores import score_heads
from benchmarks.real import SUBJECTS, Figures, RealJob, film_phone_capture, table_lines
from benchmarks.stopwatch import limit_threads
from capture.source_opening import open_source
from export.bake.bake_tables import ExportRefused
from export.build import export_avatar
from export.player import Player, premultiply
from instant_avatar.run.session_start import new_trainer

CUTS = {"sixth": 6, "third": 3, "half": 2, "all": 1}
"""Parts of a film, by what they are called: the first one of this number."""
SCORED_HELD_OUT = 6
"""Held-out frames that are scored, evenly spread."""
VALIDATION_VIEWS = 4
"""Held-out views that a package is validated with."""
COARSE_SUBJECT: Literal[1, 2, 3] = 2
"""The actor whose whole film is also learnt from coarse poses, and from none."""
FILM_FRAMES = 120
"""Most frames, evenly spread, of a film of your own that are learnt from."""


@dataclass(frozen=True, kw_only=True)
class AnyFilmJob:
    """Learns avatars from parts of a turn and from any film, and scores them from all sides."""

    films: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Videos, which are tracked, and capture folders."""
    subjects: int = 3
    """How many phone-like actors; 0: only the films named."""
    cuts: tuple[Literal["sixth", "third", "half", "all"], ...] = ("sixth", "third", "half", "all")
    """Parts of the actors' films."""
    coarse_error: float = 2.5
    """Factor of a good tracker's errors in poses that are compared with none; 0: not done."""
    size: int = 400
    """Height of the actors' pictures, and longer side of training."""
    frames: int = 120
    """Frames of a whole film of an actor, who turns twice."""
    steps: int = 1500
    """Steps of training."""
    seed: int = 0
    """Of the films and of training."""
    export: bool = True
    """Whether to make packages, and to compare their player with the renderer."""
    quick: bool = False
    """One actor, his first sixth, 200 steps."""
    folder: Path = Path(tempfile.gettempdir()) / "instant-avatar-real"
    """Where films are kept for the next time, and pictures are left."""
    json: Path | None = None
    """File for the figures."""

    @property
    def effective(self) -> "AnyFilmJob":
        """The job with what `quick` means."""
        if not self.quick:
            return self
        return replace(
            self, subjects=min(self.subjects, 1), cuts=("sixth",), steps=200, coarse_error=0.0
        )


def main() -> None:
    """The benchmark."""
    job = tyro.cli(AnyFilmJob, prog="python -m benchmarks.any_film", description=__doc__).effective
    hardware, columns = Hardware.here(), dict[str, Figures]()
    for name, figures in measure_all(job):
        columns[name] = figures
        print(name, figures, file=sys.stderr, flush=True)
    title = f"{job.frames} frames, {job.size} px tall, {job.steps} steps, seed {job.seed}"
    print("\n".join([*hardware.lines(), title, "", *table_lines(columns)]))
    if job.json is not None:
        content = {"hardware": asdict(hardware), "title": title, "figures": columns}
        job.json.write_text(json.dumps(content, indent=1) + "\n")


def measure_all(job: AnyFilmJob) -> Iterator[tuple[str, Figures]]:
    """Each column of the table, by its heading."""
    limit_threads(1)
    job.folder.mkdir(parents=True, exist_ok=True)
    filming = RealJob(size=job.size, frames=job.frames, seed=job.seed, folder=job.folder)
    for subject in SUBJECTS[: job.subjects]:
        film = film_phone_capture(filming, subject)
        for cut in job.cuts:
            name = f"{subject}, {cut}"
            frames = slice(0, job.frames // CUTS[cut])
            yield name, measure_film(job, film, frames, name)
    if job.coarse_error and job.subjects:
        coarse = film_phone_capture(filming, COARSE_SUBJECT, tracker_error=job.coarse_error)
        tracked = track_film(coarse / "video.mp4", job.folder / f"tracked-{coarse.name}")
        if not (tracked / "truth").exists():
            (tracked / "truth").symlink_to(coarse / "truth")
        for name, folder in (("coarse poses", coarse), ("no poses", tracked)):
            name = f"{COARSE_SUBJECT}, {name}"
            yield name, measure_film(job, folder, None, name)
    for film in job.films:
        name = film.resolve().stem
        folder = film if film.is_dir() else track_film(film, job.folder / f"tracked-{name}")
        yield name, measure_film(job, folder, spread_frames(folder), name)


def track_film(film: Path, folder: Path) -> Path:
    """A capture folder of a video, with poses and masks that are tracked unless they lie there."""
    if not (folder / "poses.npz").exists():
        folder.mkdir(parents=True, exist_ok=True)
        link = folder / f"video{film.suffix}"
        link.unlink(missing_ok=True)
        link.symlink_to(film.resolve())
        out = folder / "poses.npz"
        words = [sys.executable, "-m", "instant_avatar.track", str(link), "--out", str(out)]
        subprocess.run(words, cwd=ROOT, check=True, stdout=sys.stderr)
    return folder


def spread_frames(folder: Path) -> slice | None:
    """At most `FILM_FRAMES` of the frames that have pose and mask, evenly spread; None for all."""
    with np.load(folder / "poses.npz") as poses:
        numbers = poses["frame"] if "frame" in poses else np.arange(len(poses["transl"]))
        numbers = numbers[poses["valid"]] if "valid" in poses else numbers
    masked = [int(path.stem) for path in folder.glob("masks/*") if path.stem.isdecimal()]
    numbers = np.intersect1d(numbers, masked) if masked else numbers
    if len(numbers) <= FILM_FRAMES:
        return None
    step = int(np.diff(numbers).min()) * -(-len(numbers) // FILM_FRAMES)
    return slice(int(numbers[0]), int(numbers[-1]) + 1, step)


def measure_film(job: AnyFilmJob, folder: Path, frames: slice | None, name: str) -> Figures:
    """Learns some frames of a capture, and scores the avatar.

    Args:
        job: Of the benchmark.
        folder: Capture.
        frames: Frames that are used; all if None.
        name: Of the file that shows the avatar from all sides.
    """
    size_px = job.size if folder.parent == job.folder else min(longer_side(folder), job.size)
    compared = ComparedCapture.open(folder, size_px, frames=frames)
    trainer = new_trainer(
        compared.capture, seconds=60.0, steps=job.steps, seed=job.seed, refine_poses=True,
    )  # fmt: skip
    for frame in compared.frames:
        trainer.add_frame(frame)
    step_ms = train_for_steps(trainer, job.steps)
    held_out = spread(compared.held_out, SCORED_HELD_OUT)
    figures = avatar_figures(trainer, held_out, compared.novel, job.folder / f"{name}.png")
    if size_px < longer_side(folder):
        filmed = ComparedCapture.open(folder, None, frames=frames).held_out
        head = score_heads(trainer, spread(filmed, SCORED_HELD_OUT))
        figures["head as filmed, fitted: PSNR, dB"] = None if head is None else head.whole
        figures["head as filmed, without its border: PSNR, dB"] = head and head.inside
    figures |= {
        "skin that was seen, %": 100.0 * float(trainer.unseen.evidence.seen.mean()),
        "samples a ray": trainer.samples / trainer.rays,
        "core-ms a step": step_ms,
    }
    return figures | (package_figures(trainer.avatar, held_out) if job.export else {})


def longer_side(folder: Path) -> int:
    """Longer side of a capture's pictures, pixels."""
    video = next((path for path in sorted(folder.iterdir()) if path.stem == "video"), None)
    return max(open_source(video or folder / "images").size_px)


def spread(frames: list[HeldOutFrame], count: int) -> list[HeldOutFrame]:
    """At most `count` of the frames, evenly spread."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[place] for place in places]


def train_for_steps(trainer: Trainer, steps: int) -> float:
    """Makes the steps of a whole training; returns the core time of one, milliseconds."""
    began = time.process_time()
    for step in range(steps):
        done = step / steps
        falling = cosine_decay(done)
        trainer.step(
            rate=falling, hard_surface_share=min(1.0, 4.0 * done), detail_share=1.0 - falling
        )
    return 1e3 * (time.process_time() - began) / steps


def avatar_figures(
    trainer: Trainer, held_out: list[HeldOutFrame], novel: list[HeldOutFrame], shown: Path | None
) -> Figures:
    """Scores of the renderer, those of sides and poses that were not filmed first.

    Args:
        trainer: Trainer of the avatar.
        held_out: Frames of the film.
        novel: Poses that were never filmed, with true pictures; empty where there are none.
        shown: File for a picture of the avatar from all sides; None for none.
    """
    pictures = render_unfilmed_views(trainer.avatar)
    if shown is not None:
        white = [np.clip(composite_on_white(each), 0.0, 1.0)[..., ::-1] for each in pictures]
        rows = [np.hstack(white[: len(white) // 2]), np.hstack(white[len(white) // 2 :])]
        cv2.imwrite(str(shown), (255.0 * np.vstack(rows)).astype(np.uint8))
    in_novel, in_held = (fitted_psnr(trainer, frames) for frames in (novel, held_out))
    return {
        "novel poses, fitted: PSNR, dB": in_novel[0],
        "novel poses, fitted: PSNR in the mask, dB": in_novel[1],
        "half-transparent pixels, %": 100.0 * half_transparent_share(pictures),
        "held out, fitted poses: PSNR, dB": in_held[0],
    }


def fitted_psnr(trainer: Trainer, frames: list[HeldOutFrame]) -> tuple[float | None, float | None]:
    """Mean PSNR in poses fitted to the frames, dB: on white, and in the mask; None without any."""
    if not frames:
        return None, None
    scores = [score_frame(trainer.avatar, frame) for frame in fit_test_poses(trainer, frames)]
    return (
        float(np.mean([score.psnr for score in scores])),
        float(np.mean([score.psnr_mask for score in scores])),
    )


def package_figures(avatar: Avatar, held_out: list[HeldOutFrame]) -> Figures:
    """Size of the package, and its player's pictures of unfilmed views beside the renderer's."""
    views = [(held.observation.pose, held.observation.camera) for held in held_out]
    player, size, began = None, None, time.process_time()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.iavatar"
        try:
            list(export_avatar(avatar, path, views=views[:VALIDATION_VIEWS], metrics={}))
        except ExportRefused as refusal:
            print(refusal, file=sys.stderr)
        else:
            player, size = Player.load(path, tier="hq"), path.stat().st_size
    baking_s, found = time.process_time() - began, list[float]()
    if player is not None:
        for (pose, camera), picture in zip(
            unfilmed_views(avatar.rig), render_unfilmed_views(avatar), strict=True
        ):
            drawn = composite_on_white(premultiply(player.render(pose, camera)))
            found.append(psnr(drawn, composite_on_white(picture)))
    return {
        "player to renderer, unfilmed views, dB": float(np.mean(found)) if found else None,
        "package, MB": None if size is None else size / 1e6,
        "baking and checks, core-s": baking_s,
    }


if __name__ == "__main__":
    main()
