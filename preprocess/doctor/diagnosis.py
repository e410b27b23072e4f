"""Finds the mistake that, undone, makes body and masks agree."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import CAUSES, Cure, refocused, rescaled, shifted
from preprocess.doctor.evidence import Evidence
from preprocess.doctor.mistakes import cures
from preprocess.doctor.soundness import jumps
from preprocess.doctor.view import centring, standing

GOOD, USABLE = 0.7, 0.5
"""Agreement from which a capture is well, and below which nothing can be learnt from it."""
DOUBTFUL, SURER = 0.65, 0.05
"""Below the first, what was found explains little, and the camera is sought in the masks; it must
explain so much more, as it has six numbers to be fitted."""
GAIN = 0.02
"""What a discrete cure must win to be named."""
FITTED_GAIN, FITTED_CHANGE = 0.04, 0.06
"""What a fitted one must win and change (relatively): clothes make everybody a little larger."""
FITTED = ("focal", "body_scale")
CERTAIN = 3.0
"""By how many standard errors, over the frames, a gain must be above nothing."""
LOST = 0.3
"""Share of the frames with poses that a cure may leave without one before they count as missed."""
MOST_CURES = 3
QUICK = 6
"""Frames of the first look; guesses among the best `KEPT` there are looked at in all frames."""
KEPT = 8
"""Guesses that are looked at in all frames."""
TIE = 0.004
"""Gains this close are equal; then the cause that stands first in `CAUSES` is named."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tried:
    """A guess, and the agreement it would bring: in the mean, and in each frame."""

    cure: Cure
    iou: float
    scores: Float[np.ndarray, "witnesses"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis:
    """What is wrong with a capture.

    Attributes:
        now: Mean agreement as the files are, in [0, 1].
        after: The same with all named cures.
        cures: The mistakes found, the one that matters most first, as they are to be undone.
        tried: The best guess of each cause in the first round, best first.
        scores: Each frame's agreement as the files are; NaN where a frame has no pose.
        healed: The claim with all cures.
    """

    now: float
    after: float
    cures: tuple[Cure, ...]
    tried: tuple[Tried, ...]
    scores: Float[np.ndarray, "witnesses"]
    healed: Claim


def mean(scores: Float[np.ndarray, "witnesses"]) -> float:
    """Mean agreement of the frames that have a pose; 0 if none has."""
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if len(known) else 0.0


def diagnose(claim: Claim, evidence: Evidence, frames: int) -> Diagnosis:
    """Tries the usual mistakes, and again with the best one undone, while that helps.

    Args:
        claim: What the files say.
        evidence: Masks of a few frames.
        frames: How many frames the capture has.
    """
    first = evidence.scores(claim)
    named, healed, tried = _mended(claim, evidence, frames)
    for sought in (centring,) if jumps(claim)[0] else (centring, standing):
        so_far = mean(evidence.scores(healed))
        if (so_far >= DOUBTFUL and len(named) < MOST_CURES) or evidence.boxes:
            break
        found = sought(claim, evidence)
        if found is None:
            continue
        others, better, _ = _mended(found.undo(claim), evidence, frames)
        least, scores = GOOD if sought is centring else USABLE, evidence.scores(better)
        gained = mean(scores) > max(least, so_far + SURER)
        if gained and np.nanpercentile(scores, 10) > USABLE:  # or it is a bargain between two
            named, healed = [found, *others], better
            tried = _best_of_each_cause([*tried, *_looked_at([found], claim, evidence)])
    return Diagnosis(
        now=mean(first), after=mean(evidence.scores(healed)), cures=tuple(named), tried=tried,
        scores=first, healed=healed,
    )  # fmt: skip


def _mended(
    claim: Claim, evidence: Evidence, frames: int
) -> tuple[list[Cure], Claim, tuple[Tried, ...]]:
    """Undoes what helps most, again and again: the cures, the result, the first round's guesses."""
    scores = evidence.scores(claim)
    named: list[Cure] = []
    tried: tuple[Tried, ...] = ()
    healed = claim
    while len(named) < MOST_CURES:
        guesses = _best_guesses(healed, evidence, frames)
        worth = [guess for guess in guesses if _is_worth_it(guess, healed, scores)]
        if not named:
            tried = _best_of_each_cause(guesses)
        if not worth:
            break
        best = max(guess.iou for guess in worth)
        level = [guess for guess in worth if guess.iou > best - TIE]
        chosen = min(level, key=lambda guess: CAUSES.index(guess.cure.cause)).cure
        named.append(chosen)
        healed = chosen.undo(healed)
        scores = evidence.scores(healed)
    return *_polished(named, claim, healed, evidence), tried


def _polished(
    named: list[Cure], claim: Claim, healed: Claim, evidence: Evidence
) -> tuple[list[Cure], Claim]:
    """Fits again what was fitted before other mistakes were undone."""
    pelvis = evidence.skin.shaped.joints[0]
    for place, cure in enumerate(named[:-1]):
        if cure.factor is not None:
            make = _maker(cure.cause, pelvis)
            again = fit_factor(make, healed, evidence, near=True).factor or 1.0
            named[place] = make(cure.factor * again)
            healed = claim
            for each in named:
                healed = each.undo(healed)
    return named, healed


def _maker(cause: str, pelvis: Float[np.ndarray, "3"]) -> Callable[[float], Cure]:
    """What makes a cure of a factor."""
    return refocused if cause == "focal" else lambda factor: rescaled(factor, pelvis)


def _best_guesses(claim: Claim, evidence: Evidence, frames: int) -> list[Tried]:
    """The most promising guesses, looked at in all frames."""
    few, pelvis = evidence.some(QUICK), evidence.skin.shaped.joints[0]
    guesses = _looked_at(cures(claim, pelvis, frames), claim, few)
    shifts = [guess for guess in guesses if guess.cure.cause == "frame_offset"]
    guesses += _looked_at(_nearer_shifts(shifts, claim), claim, few)
    guesses += _looked_at(_fitted(claim, few), claim, few)
    guesses.sort(key=lambda guess: -guess.iou)
    kept = guesses[:KEPT] + list(_best_of_each_cause(guesses[KEPT:]))
    return _looked_at([guess.cure for guess in kept], claim, evidence)


def _looked_at(some: Iterable[Cure], claim: Claim, evidence: Evidence) -> list[Tried]:
    looked = [(cure, evidence.scores(cure.undo(claim))) for cure in some]
    return [Tried(cure=cure, iou=_worth(scores), scores=scores) for cure, scores in looked]


def _worth(scores: Float[np.ndarray, "witnesses"]) -> float:
    """Mean agreement; frames without a pose count as missed where they are more than half."""
    if 2 * np.isfinite(scores).sum() >= len(scores):
        return mean(scores)
    return float(np.nansum(scores)) / len(scores)


def _nearer_shifts(shifts: list[Tried], claim: Claim) -> list[Cure]:
    """Offsets around the best of the coarse ones."""
    if not shifts:
        return []
    best = max(shifts, key=lambda guess: guess.iou).cure.undo(claim)
    center = round(float(np.median(claim.places - best.places)))
    reach = max(1, abs(center) // 5)
    around = range(center - reach, center + reach + 1)
    return [shifted(k) for k in around if k not in (0, center)]


def _fitted(claim: Claim, evidence: Evidence) -> list[Cure]:
    """The focal length and the size that fit best, one at a time."""
    if evidence.boxes:
        return []
    pelvis = evidence.skin.shaped.joints[0]
    return [fit_factor(_maker(cause, pelvis), claim, evidence) for cause in FITTED]


def fit_factor(
    make: Callable[[float], Cure], claim: Claim, evidence: Evidence, *, near: bool = False
) -> Cure:
    """The factor that agrees best: a coarse look (unless it is near 1), then a narrow one.

    Args:
        make: What makes a cure of a factor: `refocused`, `rescaled`.
        claim: What the cure is applied to.
        evidence: Masks of a few frames.
        near: Whether the factor is within 20 % of 1.
    """
    from scipy.optimize import minimize_scalar  # 0.1 s that a capture in order does not need

    logs = np.zeros(1) if near else np.linspace(-0.8, 0.8, 9)

    def loss(log: float) -> float:
        return -_worth(evidence.scores(make(float(np.exp(log))).undo(claim)))

    coarse = [loss(log) for log in logs]
    center = float(logs[int(np.argmin(coarse))])
    found = minimize_scalar(
        loss,
        bounds=(center - 0.2, center + 0.2), method="bounded", options={"maxiter": 10},
    )  # fmt: skip
    return make(float(np.exp(found.x)))


def _best_of_each_cause(guesses: list[Tried]) -> tuple[Tried, ...]:
    best: dict[str, Tried] = {}
    for guess in guesses:
        if guess.cure.cause not in best or guess.iou > best[guess.cure.cause].iou:
            best[guess.cure.cause] = guess
    return tuple(sorted(best.values(), key=lambda guess: -guess.iou))


def _is_worth_it(guess: Tried, claim: Claim, scores: Float[np.ndarray, "witnesses"]) -> bool:
    """Whether a guess wins enough, in frame after frame."""
    gains = guess.scores - np.nan_to_num(scores)
    had, lost = np.isfinite(scores), np.isfinite(scores) & ~np.isfinite(guess.scores)
    if lost.sum() > LOST * had.sum():  # it explains the rest, and gives these away
        gains = np.where(lost, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores):
        return False
    fitted = guess.cure.factor is not None
    if fitted and _change(claim, guess.cure.undo(claim)) < FITTED_CHANGE:
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    return bool(gains.mean() > (FITTED_GAIN if fitted else GAIN) and gains.mean() > CERTAIN * error)


def _change(before: Claim, after: Claim) -> float:
    """How far a fitted cure moves its number, relatively."""
    focal = after.intrinsics[0, 0, 0] / before.intrinsics[0, 0, 0]
    places = np.linalg.norm(after.motion.root_translations - before.motion.root_translations)
    size = places / max(float(np.linalg.norm(before.motion.root_translations)), 1e-9)
    return max(abs(float(np.log(focal))), float(size))
