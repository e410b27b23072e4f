"""Verdicts on avatars that are surely not sharp from all sides, and on some that are.

    python -m benchmarks.verdicts [--only WORD]

Twenty small avatars of the studio's actors are one-sided (learnt from a part of a turn), fogged
(few steps) or shredded (without the priors that keep surfaces firm, from poses far off, from few
frames); five more show a whole turn. Each gets the verdict that its report would carry. None of
the twenty may be called sharp, and none of the five blurred: such words are bold. Prints one table.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import mean
from typing import Literal, NamedTuple

import tyro

from avatar.evaluation.all_round_verdict import AllRoundVerdict
from avatar.evaluation.coverage import Coverage
from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.image_metrics import better_verdict, overall_verdict
from avatar.training.trainer import Trainer
from baselines.hardware import Hardware
from baselines.systems.compared_capture import ComparedCapture
from benchmarks.any_film import train_for_steps
from benchmarks.measurements import format_value
from benchmarks.real import SUBJECTS, RealJob, film_phone_capture
from benchmarks.sample_training import film_sample
from benchmarks.stopwatch import limit_threads
from export.bake.bake_tables import ExportRefused
from export.build import export_avatar
from instant_avatar.run.final_scoring import score_finally
from instant_avatar.run.session_start import new_trainer
from preprocess.observation import Observation

FRAMES = 60
"""Frames of each film."""
PACKAGE_VIEWS = 2
"""Held-out views that a package is validated with."""
NO_PRIORS = {
    "double_well_weight": 0.0, "interior_weight": 0.0, "density_slope_weight": 0.0,
    "color_tv_weight": 0.0, "min_occupied_density": 0.0, "off_skin_weight": 0.0,
    "head_interior_weight": 0.0, "unseen_weight": 0.0,
}  # fmt: skip
"""Changes of the training configuration that let fog imitate each view."""


class Film(NamedTuple):
    """Frames of an actor's film.

    Attributes:
        subject: Which actor.
        end: How many frames, from the first.
        stride: Step between these frames.
        tracker_error: Factor of a good tracker's errors in the given poses; None: all is exact.
    """

    subject: Literal[1, 2, 3]
    end: int = FRAMES
    stride: int = 1
    tracker_error: float | None = 1.0


class JudgedAvatar(NamedTuple):
    """How an avatar is made.

    Attributes:
        name: What is special about it, after the actor's number.
        film: What it is learnt from.
        steps: Share of a whole training's steps.
        has_priors: Whether surfaces are kept firm, and unseen skin is completed.
        is_good: Whether it may not be called blurred; it may not be called sharp otherwise.
    """

    name: str
    film: Film
    steps: float = 1.0
    has_priors: bool = True
    is_good: bool = False


def judged_avatars() -> Iterator[JudgedAvatar]:
    """Twenty that are poor and five that are good; those of one film follow each other."""
    for subject in SUBJECTS:
        sixth = Film(subject, FRAMES // 6)
        yield JudgedAvatar("a sixth of the film", sixth)
        yield JudgedAvatar("a sixth, no priors", sixth, has_priors=False)
        yield JudgedAvatar("a third of the film", Film(subject, FRAMES // 3))
        yield JudgedAvatar("a tenth of the steps", Film(subject), steps=0.1)
        yield JudgedAvatar("the whole film", Film(subject), is_good=True)
    yield JudgedAvatar("six frames of a turn", Film(1, stride=FRAMES // 6))
    yield JudgedAvatar("the whole film, no priors, a quarter of the steps", Film(3), 0.25, False)
    for subject in SUBJECTS[:2]:
        exact = Film(subject, tracker_error=None)
        yield JudgedAvatar("a sixth, exact poses", exact._replace(end=FRAMES // 6))
        yield JudgedAvatar("a twentieth of the steps, exact poses", exact, 0.05)
        yield JudgedAvatar("the whole film, exact poses", exact, is_good=True)
    far = Film(2, tracker_error=3.0)
    yield JudgedAvatar("poses far off", far)
    yield JudgedAvatar("poses far off, no priors", far, has_priors=False)


@dataclass(frozen=True, kw_only=True)
class VerdictJob:
    """Learns small avatars, poor and good ones, and judges each as a report would."""

    size: int = 200
    """Height of the pictures."""
    steps: int = 300
    """Steps of a whole training."""
    only: str = ""
    """Leaves out the avatars whose name does not hold this."""
    seed: int = 0
    """Of the films and of training."""
    folder: Path = Path(tempfile.gettempdir()) / "instant-avatar-real"
    """Where films are kept for the next time."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(VerdictJob, prog="python -m benchmarks.verdicts", description=__doc__)
    limit_threads(1)
    job.folder.mkdir(parents=True, exist_ok=True)
    print("\n".join([*Hardware.here().lines(), f"{job.size} px tall, {job.steps} steps", ""]))
    columns = ("avatar", "verdict", "limit", "held out", "seen", "half-transparent", "player, dB")
    print("|", " | ".join(columns), "|\n" + "|---" * len(columns) + "|")
    wrong = 0
    for case in judged_avatars():
        name = f"{case.film.subject}: {case.name}"
        if job.only not in name:
            continue
        verdict, cells = judge(job, case)
        is_wrong = verdict in (("blurred", "failed") if case.is_good else ("sharp",))
        wrong += is_wrong
        word = f"**{verdict}**" if is_wrong else f"{verdict}"
        print("|", " | ".join([name, word, *cells]), "|", flush=True)
    print(f"\nwrong words: {wrong}")


def judge(job: VerdictJob, case: JudgedAvatar) -> tuple[str | None, list[str]]:
    """Learns an avatar; its verdict, and what it rests on."""
    compared = open_film(job, case.film)
    steps = round(case.steps * job.steps)
    trainer = new_trainer(
        compared.capture, seconds=60.0, steps=steps, seed=job.seed, refine_poses=True
    )
    if not case.has_priors:
        trainer = Trainer(compared.rig, replace(trainer.config, **NO_PRIORS))
    coverage = Coverage(compared.capture.shaped)
    for frame in compared.frames:
        trainer.add_frame(frame)
    for item in compared.capture.observations():
        if isinstance(item, Observation):
            coverage.add(item)
    train_for_steps(trainer, steps)
    scores = score_finally(trainer, compared.held_out, fit_poses=True)
    held_out = better_verdict(overall_verdict(scores.given), overall_verdict(scores.fitted))
    known = {
        "seen": coverage.seen_share,
        "mean_cosine": coverage.mean_cosine,
        "half_transparent": scores.half_transparent,
    }
    found, player = AllRoundVerdict.of(held_out, **known, player_psnr=None, film_advice=""), None
    if found.verdict == "sharp":  # a package can only make it worse
        player = player_psnr(trainer, compared.held_out)
        found = AllRoundVerdict.of(held_out, **known, player_psnr=player, film_advice="")
    return found.verdict, [
        found.limit or "",
        f"{held_out}, {mean(score.psnr for score in scores.fitted):.1f} dB",
        f"{coverage.seen_share:.0%}, {coverage.mean_cosine:.2f}",
        f"{scores.half_transparent or 0.0:.1%}",
        format_value(player),
    ]


@lru_cache(maxsize=1)
def open_film(job: VerdictJob, film: Film) -> ComparedCapture:
    """The frames of a film, which is made unless it lies there already."""
    if film.tracker_error is None:
        name = f"exact-{film.subject}-{job.size}px-{FRAMES}-seed{job.seed}"
        options = {"subject": film.subject, "frames": FRAMES, "seed": job.seed}
        folder = film_sample(job.folder / name, job.size, **options)
    else:
        filming = RealJob(size=job.size, frames=FRAMES, seed=job.seed, folder=job.folder)
        folder = film_phone_capture(filming, film.subject, tracker_error=film.tracker_error)
    return ComparedCapture.open(folder, None, frames=slice(0, film.end, film.stride))


def player_psnr(trainer: Trainer, held_out: list[HeldOutFrame]) -> float | None:
    """PSNR of the package's best tier to the renderer, dB; None if there is no package."""
    views = [(held.observation.pose, held.observation.camera) for held in held_out[:PACKAGE_VIEWS]]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.iavatar"
        try:
            (report,) = export_avatar(trainer.avatar, path, views=views, metrics={})
        except ExportRefused:
            return None
    return report.psnr_to_renderer["hq"]


if __name__ == "__main__":
    main()
