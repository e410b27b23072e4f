"""Continual learning: add a video to a trained avatar, replay earlier ones, measure forgetting."""

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
    """The videos that an avatar was trained on before this one.

    Their key frames stay in the replay buffer and compete with new ones for its places; their
    held-out frames measure forgetting.
    """

    def __init__(self, run: RunFolder, notes: dict[str, Any]) -> None:
        """Load the frames of earlier videos, if there are any.

        Args:
            run: Its checkpoint folder holds the frames.
            notes: Stored with each checkpoint; updated with what an interrupted run needs.
        """
        self._run, self._notes = run, notes
        began = "before" in notes  # otherwise the file is from a run that was killed at its start
        self._kept = (
            SavedFrames.load(run.checkpoint / EARLIER_VIDEOS_FILE) if began else SavedFrames([], [])
        )

    @property
    def held_out(self) -> list[HeldOutFrame]:
        """Held-out frames of earlier videos."""
        return self._kept.held_out

    def start_new_video(self, trainer: Trainer, console: Console) -> None:
        """Turn the previous video into an earlier one, and score its held-out frames."""
        self._kept = SavedFrames.load(self._run.checkpoint / LAST_RUN_FILE).as_earlier_video()
        self._kept.save(self._run.checkpoint / EARLIER_VIDEOS_FILE)
        trainer.pose_corrections = {
            index - INDEX_SHIFT_PER_VIDEO: correction
            for index, correction in trainer.pose_corrections.items()
        }
        gains = trainer.exposures.by_frame
        trainer.exposures.restore(
            {index - INDEX_SHIFT_PER_VIDEO: gain for index, gain in gains.items()}
        )
        if not self._kept.replay_frames:
            console.warning(
                "The previous video's run did not finish, so its key frames were not saved: they "
                "cannot be replayed, and forgetting cannot be measured."
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
        """Put the key frames of earlier videos back into the replay buffer."""
        if not self._kept.replay_frames:
            return
        count = len(self._kept.replay_frames)
        with console.status(f"preparing {count} frames of the earlier video"):
            for frame in self._kept.training_frames(trainer.avatar.rig):
                trainer.add_frame(frame, is_restored=True)

    def measure_forgetting(
        self, trainer: Trainer, held_out: list[HeldOutFrame], console: Console
    ) -> ForgettingStats | None:
        """Save frames for the next video; compare scores of earlier videos, if there are any.

        Args:
            trainer: After its last step.
            held_out: Held-out frames of the current video.
            console: Shows the result.

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
                "Held-out frames of the earlier video: "
                f"{format_psnr(note.psnr_before, overall_verdict(before))} before, "
                f"{format_psnr(note.psnr_after, overall_verdict(after))} now (largest drop "
                f"{note.largest_drop:.2f} dB)."
            )
        return note

    def _previous_video_name(self) -> str:
        """Return the file name of the previous video."""
        return self._notes.get("name") or Path(self._notes["video"]).name

    def _score_earlier_videos(self, trainer: Trainer) -> tuple[HeldOutScore, ...]:
        """Score the held-out frames; frame numbers are those of their own video."""
        scores = (score_frame(trainer.avatar, frame) for frame in self.held_out)
        return tuple(replace(each, frame=number_in_video(each.frame)) for each in scores)


def earlier_video_names(notes: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of the videos before the current one from a checkpoint's notes."""
    return tuple(notes.get("before", {}).get("videos", ()))
