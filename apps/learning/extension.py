"""Another video added to a finished avatar: what it knew stays, and what it loses is said."""

from dataclasses import replace
from pathlib import Path
from typing import Any, final

from apps.learning.run_folder import RunFolder
from apps.reporting.report import ExtendedNote, decibels
from apps.terminal.console import Console
from avatar.events import Score
from avatar.hold import HeldOut, score
from avatar.kept_frames import (
    CLIP,
    EARLIER,
    FINISHED,
    KeptFrames,
    number_in_video,
    videos_ago,
)
from avatar.sharpness import verdict_of
from avatar.trainer import Trainer


@final
class Extension:
    """The videos that were learnt before this one.

    Their key frames stay in replay beside the new ones, and compete with them for their places; a
    few frames that were never trained on say what was lost.
    """

    def __init__(self, run: RunFolder, notes: dict[str, Any]) -> None:
        """Nothing happens yet.

        Args:
            run: Whose checkpoint folder keeps the frames.
            notes: Kept with each checkpoint; what must be known after an interruption goes here.
        """
        self._run, self._notes = run, notes
        began = "before" in notes  # else the file is of a run that was killed at its start
        self._kept = KeptFrames.load(run.checkpoint / EARLIER) if began else KeptFrames([], [])

    @property
    def held(self) -> list[HeldOut]:
        """Frames of earlier videos that were never trained on."""
        return self._kept.held

    def begin(self, trainer: Trainer, console: Console) -> None:
        """Makes the video that was learnt last an earlier one, and scores it for the last time."""
        self._kept = KeptFrames.load(self._run.checkpoint / FINISHED).earlier()
        self._kept.save(self._run.checkpoint / EARLIER)
        trainer.corrections = {
            index - CLIP: correction for index, correction in trainer.corrections.items()
        }
        if not self._kept.key_frames:
            console.warn(
                "The frames of the earlier video were not kept, for its run did not come to its "
                "end: they are not learnt from again, and what they lose cannot be said."
            )
        self.recall(trainer, console)
        with console.waiting(f"scoring {len(self.held)} frames of the earlier video"):
            scores = self._scores(trainer)
        self._notes["before"] = {
            "videos": [*earlier_videos(self._notes), self._name()],
            "frames": trainer.frames_seen,
            "seconds": trainer.wall_seconds,
            "steps": trainer.steps,
            "scores": [vars(each) for each in scores],
        }

    def recall(self, trainer: Trainer, console: Console) -> None:
        """Puts the key frames of earlier videos back into the trainer's memory."""
        if not self._kept.key_frames:
            return
        count = len(self._kept.key_frames)
        with console.waiting(f"preparing {count} frames of the earlier video"):
            for frame in self._kept.prepared(trainer.avatar.rig):
                trainer.add(frame, again=True)

    def finish(
        self, trainer: Trainer, held: list[HeldOut], console: Console
    ) -> ExtendedNote | None:
        """Keeps the frames for the next video; says what the earlier ones lost, if there are any.

        Args:
            trainer: After its last step.
            held: Held-out frames of the video that was learnt now.
            console: Where it is said.

        Raises:
            OSError: If the disk is full.
        """
        kept = KeptFrames.of(trainer.replay, [*self.held, *held])
        kept.save(self._run.checkpoint / FINISHED)
        if "before" not in self._notes:
            return None
        history = self._notes["before"]
        before = tuple(Score(**each) for each in history["scores"])
        after, videos = self._scores(trainer), earlier_videos(self._notes)
        places = [len(videos) + 1 - videos_ago(h.observation.frame.index) for h in self.held]
        note = ExtendedNote.of(
            before, after, videos=videos, video_of_frame=places,
            used=history["frames"], wall_seconds=history["seconds"],
            recalled=len(self._kept.key_frames),
        )  # fmt: skip
        if note.psnr_after is not None:
            console.say(
                "Frames of the earlier video: "
                f"{decibels(note.psnr_before, verdict_of(before))} before, "
                f"{decibels(note.psnr_after, verdict_of(after))} now; none lost more than "
                f"{note.largest_fall:.2f} dB."
            )
        return note

    def _name(self) -> str:
        """Of the video that was learnt last, as its user named it."""
        return self._notes.get("name") or Path(self._notes["video"]).name

    def _scores(self, trainer: Trainer) -> tuple[Score, ...]:
        """Of the held-out frames, by the numbers that they had in their own video."""
        scores = (score(trainer.avatar, frame) for frame in self.held)
        return tuple(replace(each, frame=number_in_video(each.frame)) for each in scores)


def earlier_videos(notes: dict[str, Any]) -> tuple[str, ...]:
    """Names of the videos that were learnt before the present one, by what a checkpoint keeps."""
    return tuple(notes.get("before", {}).get("videos", ()))
