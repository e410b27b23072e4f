"""Tests for masks around given poses: the real network on the studio's actors."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.staging import portrait_camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import soft_iou
from preprocess.tracking.blazepose import (
    MAX_CLOTHING_M,
    BlazePoseSegmenter,
    _limit_to_body,
)
from preprocess.tracking.keypoints import CroppedMask

SIZE = (270, 480)


@dataclass(frozen=True, eq=False)
class Shot:
    """An actor, cut out: colors times alpha and alpha; the actor's pose, and the camera."""

    actor: Actor
    rgb: np.ndarray
    alpha: np.ndarray
    pose: BodyPose
    camera: Camera

    def before(self, picture: np.ndarray, left: int = 0) -> np.ndarray:
        """A picture of the same height with the actor in it."""
        there = picture.astype(np.float32)
        part = there[:, left : left + SIZE[0]]
        part *= 1.0 - self.alpha[..., None]
        part += 255.0 * np.clip(self.rgb, 0.0, 1.0)
        return there.astype(np.uint8)


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    found = []
    for subject in (1, 2):
        actor = Actor.of(subject)
        pose = staging.turning_motion(actor, frames=8, fps=30.0, turns=1.0, seed=0)[0]
        camera = portrait_camera(actor, SIZE[0])
        rgb, alpha = actor.render_rgb_alpha(pose, camera, supersampling=2)
        found.append(Shot(actor=actor, rgb=rgb, alpha=alpha, pose=pose, camera=camera))
    return found


def wall(width: int) -> np.ndarray:
    """Darker on the right."""
    shade = np.linspace(170, 110, width)[None, :, None]
    return np.broadcast_to(shade, (SIZE[1], width, 3)).astype(np.uint8)


def shown(picture: np.ndarray) -> Frame:
    return Frame(index=0, time_s=0.0, rgb=picture)


def iou(alpha: np.ndarray, true: np.ndarray) -> float:
    return soft_iou(true > 0.5, alpha)


def test_an_actor_is_cut_out(shots):
    shot = shots[1]
    segment = BlazePoseSegmenter(shot.actor.shaped)
    alpha = segment(shown(shot.before(wall(SIZE[0]))), shot.pose, shot.camera)
    assert iou(alpha, shot.alpha) > 0.95
    assert segment.mask_count == 1
    assert 0.7 < segment.agreement < 0.95  # clothes and hair are wider than the body


@pytest.mark.parametrize("wanted", [0, 1])
def test_of_two_persons_it_is_the_posed_one(shots, wanted):
    picture, shift = wall(440), 170
    for number, each in enumerate(shots):
        picture = each.before(picture, number * shift)
    shot = shots[wanted]
    x, y = shot.camera.center_px
    camera = replace(shot.camera, center_px=(x + wanted * shift, y), size_px=(440, SIZE[1]))
    alpha = BlazePoseSegmenter(shot.actor.shaped)(shown(picture), shot.pose, camera)
    assert iou(alpha[:, wanted * shift :][:, : SIZE[0]], shot.alpha) > 0.85


def test_a_pose_that_is_off_by_a_hand_gives_the_same_mask(shots):
    shot = shots[1]
    frame = shown(shot.before(wall(SIZE[0])))
    moved = replace(
        shot.pose, root_translation=np.array([0.08, 0.0, 0.0]) + shot.pose.root_translation
    )
    alpha = BlazePoseSegmenter(shot.actor.shaped)(frame, moved, shot.camera)
    assert iou(alpha, shot.alpha) > 0.95


def test_the_person_is_found_in_a_twentieth_of_the_light(shots, rng):
    shot = shots[1]
    dark = shot.before(wall(SIZE[0])) / 20.0
    dark = np.clip(dark + rng.normal(0.0, 1.0, dark.shape), 0, 255).astype(np.uint8)
    alpha = BlazePoseSegmenter(shot.actor.shaped)(shown(dark), shot.pose, shot.camera)
    assert iou(alpha, shot.alpha) > 0.9


@pytest.mark.parametrize(
    ("shift_m", "words"), [([9.0, 0, 0], "not in the image"), ([0.9, 0, 0], "agrees by")]
)
def test_where_the_pose_shows_no_person_there_is_no_mask(shots, shift_m, words):
    shot = shots[1]
    aside = replace(shot.pose, root_translation=shot.pose.root_translation + shift_m)
    with pytest.raises(InputError, match=words):
        BlazePoseSegmenter(shot.actor.shaped)(shown(shot.before(wall(SIZE[0]))), aside, shot.camera)


def test_what_is_far_from_the_posed_body_is_cleared():
    everything = CroppedMask(
        values=np.full((64, 64), 255, np.uint8),
        image_from_crop=np.array([[2.0, 0, 10], [0, 2, 20]]),
    )
    body = np.stack(np.meshgrid(np.arange(60.0, 80.0), np.arange(70.0, 90.0)), axis=-1)
    px_per_m = 100.0
    mask, agreed = _limit_to_body(everything, body.reshape(-1, 2), px_per_m)
    rows, columns = np.nonzero(mask.values)
    reach = MAX_CLOTHING_M * px_per_m / 2.0
    assert columns.min() == pytest.approx(25 - reach, abs=1.5)
    assert columns.max() == pytest.approx(34 + reach, abs=1.5)
    assert rows.min() == pytest.approx(25 - reach, abs=1.5)
    assert 0.0 < agreed < 0.3
