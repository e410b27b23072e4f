"""The verdict on an avatar from all sides: the worst word of four, and what to do about it.

Held-out frames tell how sharp the filmed side is. They cannot tell whether the other sides were
filmed at all, whether the surface is one from there, or whether the player shows what the renderer
does. Each of these gets a word of its own, and the worst one counts:

| word | held-out frames | skin that was filmed | half-transparent pixels | player to renderer |
|---|---|---|---|---|
| sharp | `image_metrics` | 90 % | up to 13 % | 34 dB |
| soft | | 50 % | up to 20 % | 28 dB |
| blurred | | less | more | less |
| failed | | | | |

Where the bounds come from: avatars of people who turn have 5 to 10 % half-transparent pixels in
`unfilmed_views`, most of them outlines; those that fog has torn to shreds have 17 to 41 %. A video
from one side shows 44 to 59 % of the skin, a third of a turn 79 %, a whole turn 97 to 99 %.
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


SEEN = WordBounds(0.9, 0.5)
"""Share of the skin that was filmed."""
FIRM = WordBounds(0.87, 0.8)
"""Share of pixels that are not half transparent."""
PLAYER_PSNR = WordBounds(34.0, 28.0)
"""PSNR of the player's best tier to the renderer, dB."""
TRAIN_LONGER = "train longer: the same command with --resume and more --seconds (or --steps)"
"""The cure of what more training mends."""


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
    """

    verdict: SharpnessVerdict | None
    limit: str | None
    advice: str | None
    seen: float | None
    half_transparent: float | None

    @classmethod
    def of(
        cls,
        held_out: SharpnessVerdict | None,
        *,
        seen: float | None,
        half_transparent: float | None,
        player_psnr: float | None,
        film_advice: str,
    ) -> "AllRoundVerdict":
        """Finds the worst word, and its remedy; `player_psnr` is of the player's best tier, dB."""
        words: dict[str, SharpnessVerdict | None] = {
            "filmed": SEEN.word(seen),
            "surface": None if half_transparent is None else FIRM.word(1.0 - half_transparent),
            "player": PLAYER_PSNR.word(player_psnr),
            "held_out": held_out,
        }
        known: dict[str, SharpnessVerdict] = {
            limit: word for limit, word in words.items() if word is not None
        }
        if not known or held_out is None:
            return cls(
                verdict=held_out, limit=None, advice=None, seen=seen,
                half_transparent=half_transparent,
            )  # fmt: skip
        order = get_args(SharpnessVerdict)
        worst = max(known, key=lambda limit: order.index(known[limit]))
        cures: dict[str, str] = {
            "filmed": f"{1.0 - (seen or 0.0):.0%} of the skin was not filmed, and is completed by "
            f"what was. {film_advice}",
            "surface": f"{half_transparent or 0.0:.0%} of its pixels are half transparent from "
            f"sides and in poses that were not filmed: check the poses, or {TRAIN_LONGER}.",
            "player": f"The player's pictures are {player_psnr or 0.0:.0f} dB from the renderer's: "
            f"{TRAIN_LONGER}.",
            "held_out": "Faces and hands are sharper the larger the person is in the picture: "
            f"step nearer, hold still for a moment on each side, or {TRAIN_LONGER}.",
        }
        sharp, failed = (known[worst] == word for word in ("sharp", "failed"))
        return cls(
            verdict=known[worst],
            limit=None if sharp else worst,
            advice=None if sharp or failed else cures[worst],
            seen=seen,
            half_transparent=half_transparent,
        )
