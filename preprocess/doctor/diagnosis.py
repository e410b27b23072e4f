"""Finds the mistakes that, undone, make body, masks and pictures agree."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import (
    CAUSES,
    Cure,
    film_cropped,
    film_shifted,
    refocused,
    rescaled,
    shifted,
)  # fmt: skip
from preprocess.doctor.evidence import Evidence
from preprocess.doctor.film_evidence import FilmEvidence
from preprocess.doctor.mistakes import cures, film_cures
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
FILM_GAIN, FILM_FITTED_GAIN, FILM_FITS = 0.03, 0.04, 0.6
"""What a change of the film must win of the edges' score, and what it must reach to be named."""
FILM_FITTED_CHANGE = 0.02
"""Fraction of the picture by which a side must be cut off, or added, to be named."""
FILM_CLEAR = 0.66
"""Score of the edges from which only offsets of a few frames are tried."""
CERTAIN = 3.0
"""By how many standard errors, over the frames, a gain must be above nothing."""
LOST = 0.3
"""Share of the frames with poses by which a cure may leave fewer before they count as missed."""
MOST_CURES = 3
QUICK = 6
"""Frames of the first look; guesses among the best `KEPT` there are looked at in all frames."""
KEPT = 8
"""Guesses that are looked at in all frames."""
NEAR_SHIFT = 2
"""Offsets of a film, in frames, that are tried even where it seems well."""
TIE = 0.004
"""Gains this close are equal; then the cause that stands first in `CAUSES` is named."""


@runtime_checkable
class Scored(Protocol):
    """What says how well a claim fits each of a few frames, in [0, 1]."""

    def scores(self, claim: Claim) -> Float[np.ndarray, "witnesses"]:
        """The score of each frame; NaN where nothing can be compared."""
        ...

    def some(self, count: int) -> "Scored":
        """At most `count` of the frames."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Tried:
    """A guess, and the agreement it would bring: in the mean, and in each frame.

    The agreement is that of body and masks (intersection over union), or of masks and pictures
    (the edges' score of `FilmEvidence`).
    """

    cure: Cure
    iou: float
    scores: Float[np.ndarray, "witnesses"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """What is tried, against what, and when it is worth naming.

    Attributes:
        evidence: What every guess is held against.
        listed: Every discrete mistake that a claim may have.
        fitted: Those with a size, as it fits a claim and a few frames best.
        shift: Makes the cure of an offset; its neighbors are tried around the best one.
        gain, fitted_gain: What a discrete and a fitted cure must win to be named.
        fitted_change: By how much a fitted cure must change its number, relatively.
        fits: What the result must reach, too.
        polish: What fits a fitted cure again after others were applied; None leaves it.
    """

    evidence: Scored
    listed: Callable[[Claim], Iterable[Cure]]
    fitted: Callable[[Claim, Any], list[Cure]]
    shift: Callable[[int], Cure]
    gain: float = GAIN
    fitted_gain: float = FITTED_GAIN
    fitted_change: float = FITTED_CHANGE
    fits: float = 0.0
    polish: Callable[[Cure, Claim], Cure] | None = None


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
        film: How the pictures' edges follow the masks; None if no picture was looked at.
    """

    now: float
    after: float
    cures: tuple[Cure, ...]
    tried: tuple[Tried, ...]
    scores: Float[np.ndarray, "witnesses"]
    healed: Claim
    film: "FilmFit | None" = None


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmFit:
    """How the pictures' edges follow the masks' outlines: about 0.5 by chance, 0.65 and more well.

    Attributes:
        now: Mean score as the files are.
        after: Mean score with all named cures.
        tried: The best guess of each cause that concerns the film alone, best first.
    """

    now: float
    after: float
    tried: tuple[Tried, ...]


def mean(scores: Float[np.ndarray, "witnesses"]) -> float:
    """Mean agreement of the frames that have a pose; 0 if none has."""
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if len(known) else 0.0


def diagnose(
    claim: Claim, evidence: Evidence, frames: int, film: FilmEvidence | None = None
) -> Diagnosis:
    """Tries the usual mistakes, and again with the best one undone, while that helps.

    Then the same with mistakes of the film alone, which body and masks cannot tell.

    Args:
        claim: What the files say.
        evidence: Masks of a few frames.
        frames: How many frames the capture has.
        film: A few of its pictures; None if pictures and masks cannot disagree.
    """
    found = _of_body(claim, evidence, frames)
    if film is None or evidence.boxes or not film.pictures:
        return found
    search = film_search(found.healed, film, frames)
    named, healed, tried = _mended(found.healed, search)
    fit = FilmFit(now=mean(film.scores(claim)), after=mean(film.scores(healed)), tried=tried)
    return replace(found, cures=(*found.cures, *named), healed=healed, film=fit)


def _of_body(claim: Claim, evidence: Evidence, frames: int) -> Diagnosis:
    """What is wrong between body and masks."""
    first = evidence.scores(claim)
    search = _body_search(evidence, frames)
    named, healed, tried = _mended(claim, search)
    for sought in (centring,) if jumps(claim)[0] else (centring, standing):
        so_far = mean(evidence.scores(healed))
        if (so_far >= DOUBTFUL and len(named) < MOST_CURES) or evidence.boxes:
            break
        found = sought(claim, evidence)
        if found is None:
            continue
        others, better, _ = _mended(found.undo(claim), search)
        least, scores = GOOD if sought is centring else USABLE, evidence.scores(better)
        gained = mean(scores) > max(least, so_far + SURER)
        if gained and np.nanpercentile(scores, 10) > USABLE:  # or it is a bargain between two
            named, healed = [found, *others], better
            tried = _best_of_each_cause([*tried, *_looked_at([found], claim, evidence)])
    return Diagnosis(
        now=mean(first), after=mean(evidence.scores(healed)), cures=tuple(named), tried=tried,
        scores=first, healed=healed,
    )  # fmt: skip


def _body_search(evidence: Evidence, frames: int) -> Search:
    """The search for mistakes between body and masks."""
    pelvis = evidence.skin.shaped.joints[0]

    def polished(cure: Cure, claim: Claim) -> Cure:
        make = _maker(cure.cause, pelvis)
        again = fit_factor(make, claim, evidence, near=True).factor or 1.0
        return make((cure.factor or 1.0) * again)

    return Search(
        evidence=evidence,
        listed=lambda claim: cures(claim, pelvis, frames),
        fitted=_fitted,
        shift=shifted,
        polish=polished,
    )


def film_search(claim: Claim, film: FilmEvidence, frames: int, *, quick: bool = False) -> Search:
    """The search for mistakes of the film alone.

    Args:
        claim: Poses, masks and film as they are.
        film: A few pictures and all masks.
        frames: How many frames the film has.
        quick: Leaves out what takes long: distant offsets and crops.
    """
    clear = quick or mean(film.scores(claim)) >= FILM_CLEAR
    reach = NEAR_SHIFT if clear else max(frames, film.masks)

    def windows(tried: Claim, few: FilmEvidence) -> list[Cure]:
        return [] if quick else [film_cropped(few.window(tried))]

    return Search(
        evidence=film,
        listed=lambda tried: film_cures(frames, film.masks, reach),
        fitted=windows,
        shift=film_shifted,
        gain=FILM_GAIN,
        fitted_gain=FILM_FITTED_GAIN,
        fitted_change=FILM_FITTED_CHANGE,
        fits=FILM_FITS,
    )


def film_errs(claim: Claim, film: FilmEvidence, frames: int) -> bool:
    """Whether one of the likeliest mistakes of the film alone is worth naming; a quick look."""
    search = film_search(claim, film, frames, quick=True)
    scores = film.scores(claim)
    guesses = _looked_at(search.listed(claim), claim, film)
    return any(_is_worth_it(guess, claim, scores, search) for guess in guesses)


def _mended(claim: Claim, search: Search) -> tuple[list[Cure], Claim, tuple[Tried, ...]]:
    """Undoes what helps most, again and again: the cures, the result, the first round's guesses."""
    evidence = search.evidence
    scores = evidence.scores(claim)
    named: list[Cure] = []
    tried: tuple[Tried, ...] = ()
    healed = claim
    while len(named) < MOST_CURES:
        guesses = _best_guesses(healed, search)
        worth = [guess for guess in guesses if _is_worth_it(guess, healed, scores, search)]
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
    return *_polished(named, claim, healed, search), tried


def _polished(
    named: list[Cure], claim: Claim, healed: Claim, search: Search
) -> tuple[list[Cure], Claim]:
    """Fits again what was fitted before other mistakes were undone."""
    for place, cure in enumerate(named[:-1]):
        if cure.factor is not None and search.polish is not None:
            named[place] = search.polish(cure, healed)
            healed = claim
            for each in named:
                healed = each.undo(healed)
    return named, healed


def _maker(cause: str, pelvis: Float[np.ndarray, "3"]) -> Callable[[float], Cure]:
    """What makes a cure of a factor."""
    return refocused if cause == "focal" else lambda factor: rescaled(factor, pelvis)


def _best_guesses(claim: Claim, search: Search) -> list[Tried]:
    """The most promising guesses, looked at in all frames."""
    few = search.evidence.some(QUICK)
    guesses = _looked_at(search.listed(claim), claim, few)
    shifts = [guess for guess in guesses if guess.cure.frames is not None]
    guesses += _looked_at(_nearer_shifts(shifts, search.shift), claim, few)
    guesses += _looked_at(search.fitted(claim, few), claim, few)
    guesses.sort(key=lambda guess: -guess.iou)
    kept = guesses[:KEPT] + list(_best_of_each_cause(guesses[KEPT:]))
    return _looked_at([guess.cure for guess in kept], claim, search.evidence)


def _looked_at(some: Iterable[Cure], claim: Claim, evidence: Scored) -> list[Tried]:
    looked = [(cure, evidence.scores(cure.undo(claim))) for cure in some]
    return [Tried(cure=cure, iou=_worth(scores), scores=scores) for cure, scores in looked]


def _worth(scores: Float[np.ndarray, "witnesses"]) -> float:
    """Mean agreement; frames without a pose count as missed where they are more than half."""
    if 2 * np.isfinite(scores).sum() >= len(scores):
        return mean(scores)
    return float(np.nansum(scores)) / len(scores)


def _nearer_shifts(shifts: list[Tried], make: Callable[[int], Cure]) -> list[Cure]:
    """Offsets around the best of the coarse ones."""
    if not shifts:
        return []
    center = max(shifts, key=lambda guess: guess.iou).cure.frames or 0
    reach = max(1, abs(center) // 5)
    around = range(center - reach, center + reach + 1)
    return [make(k) for k in around if k not in (0, center)]


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


def _is_worth_it(
    guess: Tried, claim: Claim, scores: Float[np.ndarray, "witnesses"], search: Search
) -> bool:
    """Whether a guess wins enough, in frame after frame."""
    gains = guess.scores - np.nan_to_num(scores)
    had, has = np.isfinite(scores), np.isfinite(guess.scores)
    if had.sum() - has.sum() > LOST * had.sum():  # it explains the rest, and gives these away
        gains = np.where(had & ~has, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores) or mean(guess.scores) < search.fits:
        return False
    fitted = guess.cure.factor is not None
    if fitted and _change(claim, guess.cure.undo(claim)) < search.fitted_change:
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    least = search.fitted_gain if fitted else search.gain
    return bool(gains.mean() > least and gains.mean() > CERTAIN * error)


def _change(before: Claim, after: Claim) -> float:
    """How far a fitted cure moves its number, relatively."""
    focal = after.intrinsics[0, 0, 0] / before.intrinsics[0, 0, 0]
    there, valid = before.motion.root_translations, before.motion.valid
    moved = np.linalg.norm((after.motion.root_translations - there)[valid])
    size = moved / max(float(np.linalg.norm(there[valid])), 1e-9)
    film = np.abs(np.subtract(after.film.window, before.film.window)).max()
    return max(abs(float(np.log(focal))), float(size), float(film))
