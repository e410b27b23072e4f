"""Learns an avatar in a few lines of Python: film an actor, train, export.

    python examples/1_learn_from_python.py [FOLDER]

The events of `train` are all there is to listen to: a progress bar, a checkpoint or a curve is
whatever you do with them.
"""

import sys
from pathlib import Path

try:
    import instant_avatar  # noqa: F401, I001 - sets OpenMP's variables, which torch reads when it is imported

    from preprocess.open_capture import open_capture
    from preprocess.capture_session import CaptureInputs
    from instant_avatar.studio.shoot import ShootConfig, film_capture
    from avatar.config import TrainConfig
    from avatar.events import Evaluated, Finished, Warned
    from avatar.training.frame_stream import prepare_stream
    from avatar.rig import Rig
    from avatar.training.train import train
    from avatar.training.trainer import Trainer
    from avatar.training.train import warm_up
    from capture.input_error import InputError
    from capture.inbox import Inbox
    from export.build import export_avatar
except ModuleNotFoundError as missing:
    sys.exit(f"{missing}. To learn, install: pip install 'instant-avatar-stream[learn]'")

STEPS = 500


def main(folder: Path) -> None:
    # Film a synthetic actor; your capture would be a video with poses and masks.
    film_capture(folder / "capture", ShootConfig(frames=48, size=96), overwrite=True)

    # Everything that is known about it, checked before a frame is read.
    recording = open_capture(CaptureInputs(video=folder / "capture"))

    # The rig never changes; the recipe follows from the number of steps and the size of a pixel.
    rig = Rig.from_shaped_body(recording.shaped)
    config = TrainConfig.for_budget(steps=STEPS, footprint_m=recording.pixel_footprint_m())
    trainer = Trainer(rig, config)
    warm_up(trainer)  # compiles kernels

    # One thread makes frames ready, this one learns from them as they come.
    frames = prepare_stream(
        recording.observations(), rig, stride=10, total=recording.source.frame_count
    )
    held_out = []
    for event in train(trainer, Inbox(frames), held_out):
        match event:
            case Evaluated(wall_seconds=seconds, scores=scores) if scores:
                psnr = sum(score.psnr for score in scores) / len(scores)
                print(f"{seconds:5.1f} s  {psnr:.2f} dB on {len(scores)} frames it never learnt")
            case Warned(message=message):
                print(message)
            case Finished(steps=steps):
                print(f"{steps} steps")

    # A package plays without torch; it is checked against the renderer before it is written.
    views = [(held.observation.pose, held.observation.camera) for held in held_out[:4]]
    report = export_avatar(trainer.avatar, folder / "avatar.iavatar", views=views, metrics={})
    print(f"{report.path}: {report.bytes / 1e6:.1f} MB, {report.psnr_to_renderer}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo/python"))
    except InputError as error:
        sys.exit(str(error))
