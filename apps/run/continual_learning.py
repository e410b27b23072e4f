"""Another video added to a finished avatar: what it knew stays, and what it loses is said."""

from dataclasses import replace
from pathlib import Path
from typing import Any, final

from apps.cli.console import Console
from apps.report.report_schema import ForgettingStats, format_psnr
from apps.run.run_folder import RunFolder
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.evaluation.sharpness import overall_verdict
from avatar.events import HeldOutScore
from avatar.training.saved_frames import (
    EARLIER_VIDEOS_FILE,
    INDEX_SHIFT_PER_VIDEO,
    LAST_RUN_FILE,
    SavedFrames,
    number_in_video,
    video_age,
)
from avatar.training.trainer import Trainer


@final
class EarlierVideos:
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
        self._kept = (
            SavedFrames.load(run.checkpoint / EARLIER_VIDEOS_FILE) if began else SavedFrames([], [])
        )

    @property
    def held_out(self) -> list[HeldOutFrame]:
        """Frames of earlier videos that were never trained on."""
        return self._kept.held_out

    def start_new_video(self, trainer: Trainer, console: Console) -> None:
        """Makes the video that was learnt last an earlier one, and scores it for the last time."""
        self._kept = SavedFrames.load(self._run.checkpoint / LAST_RUN_FILE).as_earlier_video()
        self._kept.save(self._run.checkpoint / EARLIER_VIDEOS_FILE)
        trainer.pose_corrections = {
            index - INDEX_SHIFT_PER_VIDEO: correction
            for index, correction in trainer.pose_corrections.items()
        }
        if not self._kept.replay_frames:
            console.warning(
                "The frames of the earlier video were not kept, for its run did not come to its "
                "end: they are not learnt from again, and what they lose cannot be said."
            )
        self.restore_key_frames(trainer, console)
        with console.status(f"scoring {len(self.held_out)} frames of the earlier video"):
            scores = self._score_earlier_videos(trainer)
        self._notes["before"] = {
            "videos": [*earlier_video_names(self._notes), self._previous_video_name()],
            "frames": trainer.frames_seen,
            "seconds": trainer.wall_seconds,
            "steps": trainer.steps,
            "scores": [vars(each) for each in scores],
        }

    def restore_key_frames(self, trainer: Trainer, console: Console) -> None:
        """Puts the key frames of earlier videos back into the trainer's memory."""
        if not self._kept.replay_frames:
            return
        count = len(self._kept.replay_frames)
        with console.status(f"preparing {count} frames of the earlier video"):
            for frame in self._kept.training_frames(trainer.avatar.rig):
                trainer.add_frame(frame, is_restored=True)

    def measure_forgetting(
        self, trainer: Trainer, held_out: list[HeldOutFrame], console: Console
    ) -> ForgettingStats | None:
        """Keeps the frames for the next video; says what the earlier ones lost, if there are any.

        Args:
            trainer: After its last step.
            held: Held-out frames of the video that was learnt now.
            console: Where it is said.

        Raises:
            OSError: If the disk is full.
        """
        kept = SavedFrames.of(trainer.replay, [*self.held_out, *held_out])
        kept.save(self._run.checkpoint / LAST_RUN_FILE)
        if "before" not in self._notes:
            return None
        history = self._notes["before"]
        before = tuple(HeldOutScore(**each) for each in history["scores"])
        after, videos = self._score_earlier_videos(trainer), earlier_video_names(self._notes)
        places = [len(videos) + 1 - video_age(h.observation.frame.index) for h in self.held_out]
        note = ForgettingStats.of(
            before, after, videos=videos, video_of_frame=places,
            frames_trained=history["frames"], wall_seconds=history["seconds"],
            replayed_key_frames=len(self._kept.replay_frames),
        )  # fmt: skip
        if note.psnr_after is not None:
            console.info(
                "Frames of the earlier video: "
                f"{format_psnr(note.psnr_before, overall_verdict(before))} before, "
                f"{format_psnr(note.psnr_after, overall_verdict(after))} now; none lost more than "
                f"{note.largest_drop:.2f} dB."
            )
        return note

    def _previous_video_name(self) -> str:
        """Of the video that was learnt last, as its user named it."""
        return self._notes.get("name") or Path(self._notes["video"]).name

    def _score_earlier_videos(self, trainer: Trainer) -> tuple[HeldOutScore, ...]:
        """Of the held-out frames, by the numbers that they had in their own video."""
        scores = (score_frame(trainer.avatar, frame) for frame in self.held_out)
        return tuple(replace(each, frame=number_in_video(each.frame)) for each in scores)


def earlier_video_names(notes: dict[str, Any]) -> tuple[str, ...]:
    """Names of the videos that were learnt before the present one, by what a checkpoint keeps."""
    return tuple(notes.get("before", {}).get("videos", ()))
