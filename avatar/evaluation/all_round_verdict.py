"""The verdict on an avatar from all sides: the worst word of four, and what to do about it.

Held-out frames tell how sharp the filmed side is. They cannot tell whether the other sides were
filmed at all, whether the surface is one from there, or whether the player shows what the renderer
does. Each of these gets a word of its own, and the worst one counts:

| word | held-out frames | cosine of filmed skin | half-transparent pixels | player to renderer |
|---|---|---|---|---|
| sharp | `image_metrics` | 0.85 | up to 13 % | 34 dB |
| soft | | 0.4 | up to 20 % | 28 dB |
| blurred | | less | more | less |
| failed | | | | |

Where the bounds come from: avatars of people who turn have 5 to 10 % half-transparent pixels in
`unfilmed_views`, most of them outlines; those that fog has torn to shreds have 17 to 41 %. The
cosine, 0 where skin was not filmed at all, is 0.43 of a sixth of a turn, 0.63 of a third, 0.82 of
half, and of a whole turn 0.73 in four frames, 0.83 in six, 0.87 in eight and 0.91 in all.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, get_args

from avatar.evaluation.image_metrics import SharpnessVerdict


class WordBounds(NamedTuple):
    """Least values for a word; less is blurred."""

    sharp: float
    soft: float

    def word(self, value: float | None) -> SharpnessVerdict | None:
        """The best word whose bound a value reaches; None if it was not measured."""
        if value is None or math.isnan(value):
            return None
        return "sharp" if value >= self.sharp else "soft" if value >= self.soft else "blurred"


FILMED = WordBounds(0.85, 0.4)
"""Mean over the skin of the largest cosine between its normal and a view (`Coverage`)."""
FIRM = WordBounds(0.87, 0.8)
"""Share of pixels that are not half transparent."""
PLAYER_PSNR = WordBounds(34.0, 28.0)
"""PSNR of the player's best tier to the renderer, dB."""
TRAIN_LONGER = "train longer: ia-ingest with --resume and more --seconds (or --steps)"
"""The cure of what more training mends, also of a film that ia-capture took."""


@dataclass(frozen=True, kw_only=True)
class AllRoundVerdict:
    """The verdict on an avatar, and what it rests on.

    Attributes:
        verdict: The worst of the words; None if nothing was measured.
        limit: Its criterion: filmed, surface, player or held_out; None of a sharp avatar.
        advice: The remedy, a sentence; None of a sharp avatar, and of a failed one, whose failure
            has causes of its own (`diagnose_failure`).
        seen, half_transparent: Shares, in [0, 1], of the skin that was filmed, and of
            half-transparent pixels in views that were not filmed.
        mean_cosine: Cosine between skin and view (`Coverage.mean_cosine`).
    """

    verdict: SharpnessVerdict | None
    limit: str | None
    advice: str | None
    seen: float | None
    half_transparent: float | None
    mean_cosine: float | None

    @classmethod
    def of(
        cls,
        held_out: SharpnessVerdict | None,
        *,
        seen: float | None,
        mean_cosine: float | None,
        half_transparent: float | None,
        player_psnr: float | None,
        film_advice: str,
    ) -> "AllRoundVerdict":
        """Finds the worst word, and its remedy; `player_psnr` is of the player's best tier, dB."""
        words: dict[str, SharpnessVerdict | None] = {
            "filmed": FILMED.word(mean_cosine),
            "surface": None if half_transparent is None else FIRM.word(1.0 - half_transparent),
            "player": PLAYER_PSNR.word(player_psnr),
            "held_out": held_out,
        }
        known: dict[str, SharpnessVerdict] = {
            limit: word for limit, word in words.items() if word is not None
        }
        order = get_args(SharpnessVerdict)
        worst = max(known, key=lambda limit: order.index(known[limit]), default="held_out")
        verdict = None if held_out is None else known[worst]
        cures: dict[str, str] = {
            "filmed": f"{1.0 - (seen or 0.0):.0%} of the skin was not filmed, and is completed by "
            "what was; the rest was seen at an angle of "
            f"{_mean_angle_deg(seen, mean_cosine):.0f} degrees on average. {film_advice}",
            "surface": f"{half_transparent or 0.0:.0%} of its pixels are half transparent from "
            f"sides and in poses that were not filmed: check the poses, or {TRAIN_LONGER}.",
            "player": f"The player's pictures are {player_psnr or 0.0:.0f} dB from the renderer's: "
            f"{TRAIN_LONGER}.",
            "held_out": "Faces and hands are sharper the larger the person is in the picture: "
            f"step nearer, hold still for a moment on each side, or {TRAIN_LONGER}.",
        }
        return cls(
            verdict=verdict,
            limit=None if verdict in (None, "sharp") else worst,
            advice=cures[worst] if verdict in ("soft", "blurred") else None,
            seen=seen,
            half_transparent=half_transparent,
            mean_cosine=mean_cosine,
        )


def _mean_angle_deg(seen: float | None, mean_cosine: float | None) -> float:
    """Angle between normal and view of the skin that was filmed, by its mean cosine, degrees."""
    return math.degrees(math.acos(min(1.0, (mean_cosine or 0.0) / max(seen or 0.0, 1e-6))))
