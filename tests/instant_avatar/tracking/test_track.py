"""ia-track: from a video to poses, masks, a film and grades."""

import json
import threading
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from capture.source_opening import open_source
from capture.video_writer import FFV1, write_video
from instant_avatar import check, track
from instant_avatar.cli.console import Console
from instant_avatar.run import person_tracking
from instant_avatar.studio import painted_surfaces
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.lighting import composite_over
from instant_avatar.studio.staging import static_camera, turning_motion
from preprocess.body.parametric_body import load_body_model
from preprocess.body.proportion_space import shape_for_motion
from preprocess.capture_inputs import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracking.blazepose import BlazePoseTracker


@pytest.fixture(scope="module")
def tracked(filmed, tmp_path_factory):
    """What ia-track makes of the actor's film."""
    folder = tmp_path_factory.mktemp("tracked")
    video = folder / "video.mp4"
    video.write_bytes((filmed / "video.mp4").read_bytes())
    assert track.main([str(video), "--out", str(folder / "out" / "poses.npz")]) == 0
    return folder


def joints_mm(motion):
    """Joints of each row relative to the root, millimetres."""
    shaped = shape_for_motion(load_body_model(None), motion)
    joints = np.stack([shaped.with_pose(motion[row]).joints() for row in range(len(motion))])
    return 1000.0 * (joints - joints[:, :1])


def test_poses_are_near_the_truth(tracked, filmed):
    found = joints_mm(read_poses(tracked / "out" / "poses.npz"))
    true = joints_mm(read_poses(filmed / "poses.npz"))
    true = true @ np.load(filmed / "cameras.npz")["extrinsic"][:3, :3].T  # to the camera's axes
    scale = (found * true).sum() / (found * found).sum()
    assert np.linalg.norm(scale * found - true, axis=2).mean() < 60.0


def test_masks_are_near_the_truth(tracked, filmed):
    overlaps = []
    for true in sorted((filmed / "masks").iterdir())[::5]:
        number = int("".join(filter(str.isdigit, true.stem)))
        a = cv2.imread(str(true), 0) > 127
        b = cv2.imread(str(tracked / "out" / "masks" / f"{number:06d}.png"), 0) > 127
        overlaps.append((a & b).sum() / (a | b).sum())
    assert np.mean(overlaps) > 0.85


def test_grades_and_film_are_written(tracked):
    grade = json.loads((tracked / "out" / "grade.json").read_text())
    assert grade["good_enough"]
    assert grade["found_share"] == 1.0
    assert grade["iou_mean"] > 0.75
    film = cv2.VideoCapture(str(tracked / "out" / "skeleton.mp4"))
    assert film.read()[0]
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) in (0, 20)


def test_a_capture_opens_from_what_was_written(tracked):
    capture = open_capture(
        CaptureInputs(video=tracked / "video.mp4", poses=tracked / "out" / "poses.npz")
    )
    assert capture.masks.files.path == tracked / "out" / "masks"
    assert capture.cameras.source == "K of the poses"
    assert capture.motion.proportions is not None


def test_poses_and_masks_of_some_frames_are_read_beside_the_whole_video(video, tmp_path, call):
    out = tmp_path / "out" / "poses.npz"
    ended = call(track, video, "--out", out, "--frames", "::2", "--no-film")
    assert ended.code == 0
    assert f"ia-ingest {video} --poses {out} --frames ::2" in "".join(ended.err.splitlines())
    capture = open_capture(CaptureInputs(video=video, poses=out))
    found = [each for each in capture.observations() if isinstance(each, Observation)]
    assert [each.frame.index for each in found] == list(range(0, 20, 2))


def test_ia_check_grades_tracked_poses(tracked, call, tmp_path):
    told, poses = tmp_path / "check.json", tracked / "out" / "poses.npz"
    words = ("--poses", poses, "--json", told, "--sheet", tmp_path / "sheet.png")
    ended = call(check, tracked / "video.mp4", *words)
    assert ended.code == 0
    assert "Good enough for an avatar: yes" in ended.err
    assert json.loads(told.read_text())["tracking"]["found_share"] == 1.0


@pytest.mark.slow
def test_tracking_beside_the_video_reads_and_repeats(video, call):
    words = ("--out", video.with_name("poses.npz"), "--frames", ":8", "--overwrite")
    assert call(track, video, *words).code in (0, 1)
    stamp = video.with_name("masks") / "000000.png"
    before = stamp.stat().st_ino
    again = call(track, video, *words)
    assert again.code in (0, 1), again.err
    assert stamp.stat().st_ino != before  # not taken for masks that the user has given
    assert "which lie beside the video" not in again.err
    assert open_capture(CaptureInputs(video=video.parent)).paths.video == video.parent


def test_a_video_without_a_person_is_bad_input(tmp_path, call):
    images = tmp_path / "images"
    images.mkdir()
    for number in range(4):
        noise = np.random.default_rng(number).integers(0, 255, (96, 96, 3), dtype=np.uint8)
        cv2.imwrite(str(images / f"{number}.png"), noise)
    call(track, images, "--out", tmp_path / "out" / "poses.npz").refusal()
    assert not (tmp_path / "out" / "masks").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--out", "poses.pkl"], "--out"),
        (["--person", "0"], "--person"),
        (["--cameras", "solve"], "--cameras"),
        (["--frames", "5"], "--frames"),
        (["--out", "out/p.npz", "--masks", "nowhere"], "nowhere"),
        (["--out", "out/p.npz", "--cameras", "nowhere"], "nowhere"),
        (["--out", "out/p.npz", "--body", "nowhere"], "nowhere"),
    ],
)
def test_bad_arguments_are_named_before_tracking(video, words, reason, call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ended = call(track, video, *words)
    assert reason in ended.refusal()
    assert "tracking the person" not in ended.err
    assert [path.name for path in tmp_path.iterdir()] == ["film"]


@pytest.mark.parametrize(
    ("limit", "for_learning", "step"),
    [("MAX_FRAMES", False, 3), ("FEW_FRAMES", True, 2), ("FEW_FRAMES", False, None)],
)
def test_of_a_long_video_every_nth_frame_is_tracked(video, monkeypatch, limit, for_learning, step):
    inputs, source = CaptureInputs(video=video), open_source(video)
    limit_frames = partial(person_tracking.limit_frames, source=source, for_learning=for_learning)
    assert limit_frames(inputs) == inputs  # 20 frames, 30 a second, are few
    monkeypatch.setattr(person_tracking, limit, {"MAX_FRAMES": 8, "FEW_FRAMES": 4}[limit])
    assert limit_frames(inputs) == replace(inputs, frames=step and slice(None, None, step))
    chosen = replace(inputs, frames=slice(0, 15, 1))
    assert limit_frames(chosen) == chosen


def test_what_was_found_before_ctrl_c_is_kept(video, tmp_path):
    stop = threading.Event()

    class StoppingTracker(BlazePoseTracker):
        """Is stopped in the ninth of twenty frames."""

        calls = 0

        def __call__(self, rgb):
            self.calls += 1
            if self.calls == 9:
                stop.set()
            return super().__call__(rgb)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(person_tracking, "make_tracker", lambda name, person: StoppingTracker())
        found = person_tracking.track_person(
            CaptureInputs(video=video), tmp_path / "out" / "poses.npz", Console(), stop=stop
        )
    assert found.interrupted
    assert found.grade.frames == 9
    assert len(read_poses(tmp_path / "out" / "poses.npz")) == 9
    assert len(list((tmp_path / "out" / "masks").glob("*.png"))) == 9
    assert open_capture(found.imported.inputs).source.frame_count == 9


# --- films that are hard to track -------------------------------------------------------------

FPS = 15.0


@pytest.fixture
def track_film(tmp_path, call):
    """Tracks a film of some frames; returns exit code, messages, and reasons of doubts."""

    def track_film(frames):
        write_video(tmp_path / "film.mp4", frames, FPS, FFV1)
        out = tmp_path / "out" / "poses.npz"
        ended = call(track, tmp_path / "film.mp4", "--out", out, "--no-film")
        grade = json.loads(out.with_name("grade.json").read_text())
        return ended.code, ended.err, {each["reason"] for each in grade["doubtful"]}

    return track_film


def test_legs_below_the_picture_are_the_first_cause_of_the_verdict(track_film, frames):
    code, told, reasons = track_film([frame[: int(0.7 * len(frame))] for frame in frames[::2]])
    assert code == 1
    cut = "the person is cut by the picture's lower border"
    assert cut in reasons
    assert f"Good enough for an avatar: no, because {cut} in 10 of 10 frames" in told


@pytest.mark.slow
def test_a_person_who_passes_in_front_is_named_and_in_no_mask_that_is_learnt_from(
    track_film, tmp_path
):
    """The detector, which looks for others in every fifth frame, sees the person alone in each."""
    code, _, reasons = track_film(someone_passes_in_front())
    assert code == 0
    assert "another person is so near that the two may be mixed up" in reasons
    poses = np.load(tmp_path / "out" / "poses.npz")
    masks = sorted((tmp_path / "out" / "masks").glob("*.png"))
    areas = np.array([(cv2.imread(str(path), 0) > 127).sum() for path in masks])
    learnt = areas[poses["frame"][poses["valid"]]]
    assert len(learnt) > 55  # of 72: the other is near in a few frames only
    assert learnt.max() < 1.1 * np.median(learnt)


def someone_passes_in_front():
    """One actor stands; another, a little larger, crosses the picture within eight frames."""
    size = 270
    actors = [Actor.of(seed, 0) for seed in (1, 2)]
    camera = static_camera(actors[0], size)
    behind = painted_surfaces.paint_backdrop("clutter", camera, np.random.default_rng([0, 4]))
    motion = turning_motion(actors[0], frames=2, fps=FPS, turns=0.02, seed=0)
    drawn = [[actor.render_rgb_alpha(motion[row], camera) for row in range(2)] for actor in actors]
    pictures = []
    for number in range(72):
        picture = composite_over(*drawn[0][number % 2], behind)
        moved = np.array([[1.15, 0.0, 45.0 * (number - 18) - 290], [0.0, 1.15, -22.0]])
        rgb, alpha = (cv2.warpAffine(each, moved, (size, size)) for each in drawn[1][number % 2])
        pictures.append(composite_over(rgb, alpha, picture))
    return pictures
