"""Which frames of a source are wanted: START:STOP:STEP, counted from 0."""

from dataclasses import dataclass

from capture.errors import InputError


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """Every `step`-th frame from `start` up to, not including, `stop` (None: to the end)."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    @classmethod
    def of(cls, frames: slice | None) -> "Selection":
        """From a slice; all frames if it is None.

        Raises:
            InputError: If it counts from the end, goes backwards or leaves nothing.
        """
        if frames is None:
            return cls()
        start = 0 if frames.start is None else frames.start
        step = 1 if frames.step is None else frames.step
        if start < 0 or step < 1 or (frames.stop is not None and frames.stop <= start):
            raise InputError(
                f"Frames {start}:{'' if frames.stop is None else frames.stop}:{step} name nothing; "
                "expected START:STOP:STEP with 0 <= START < STOP and STEP >= 1."
            )
        return cls(start=start, stop=frames.stop, step=step)

    def contains(self, index: int) -> bool:
        """Whether the frame with this number belongs to it."""
        return index >= self.start and not self.is_past_end(index) and not (index - self.start) % self.step

    def is_past_end(self, index: int) -> bool:
        """Whether no frame from this number on belongs to it."""
        return self.stop is not None and index >= self.stop

    def count(self, total: int) -> int:
        """How many of `total` frames belong to it."""
        return len(range(self.start, min(total, self.stop or total), self.step))

    def position(self, index: int) -> int:
        """The place of a wanted frame among the wanted ones, counted from 0."""
        return (index - self.start) // self.step

    def span(self, total: int) -> int:
        """How many of `total` frames lie from the first wanted one to the last, both counted."""
        count = self.count(total)
        return (count - 1) * self.step + 1 if count else 0
