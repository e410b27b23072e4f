"""A process that starts, learns one step from a capture folder, and says how long that took.

    python -m benchmarks.first_step CAPTURE BEGAN

BEGAN is the time, in seconds of the epoch, at which the process was started. It does what
ia-ingest does until its first step, and imports as late.
"""

import sys
import time
from pathlib import Path


def main() -> None:
    from preprocess.capture_inputs import CaptureInputs
    from preprocess.open_capture import open_capture

    capture, began = Path(sys.argv[1]), float(sys.argv[2])
    recording = open_capture(CaptureInputs(video=capture))

    from avatar.config import TrainConfig
    from avatar.evaluation.held_out import HeldOutFrame
    from avatar.events import Stepped
    from avatar.rig import Rig
    from avatar.training.frame_stream import prepare_stream
    from avatar.training.train import Trainer, train, warm_up
    from capture.inbox import Inbox
    from instant_avatar.run.session_start import set_threads

    set_threads(None)
    rig = Rig.from_shaped_body(recording.shaped)
    config = TrainConfig.for_budget(60.0, footprint_m=recording.pixel_footprint_m())
    trainer = Trainer(rig, config)
    warm_up(trainer)
    total, held = recording.source.frame_count, list[HeldOutFrame]()
    begun = time.time()
    inbox = Inbox(
        prepare_stream(recording.observations(), rig, stride=config.held_out_stride, total=total)
    )
    for event in train(trainer, inbox, held):
        if isinstance(event, Stepped):
            now = time.time()
            print(f"{now - began:.3f} {now - begun:.3f}")
            break
    inbox.close()


if __name__ == "__main__":
    main()
