"""Fixtures: a small body of random vertices, motions, and joblib's way to write arrays."""

import io
import pickle
import sys
import types
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import PARENTS
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_fitting import ClipFitter
from preprocess.tracking.keypoints import KeypointTrack
from tests.cached_networks import networks_run_once as networks_run_once
from tests.motions import make_motion, perfect_track, posed_joints


@pytest.fixture
def smpl_arrays(rng) -> dict[str, np.ndarray]:
    """What an SMPL file holds, with 40 vertices."""
    regressor = rng.random((24, 40))
    weights = rng.random((40, 24))
    return {
        "v_template": rng.normal(size=(40, 3)),
        "shapedirs": 0.01 * rng.normal(size=(40, 3, 10)),
        "posedirs": 0.001 * rng.normal(size=(40, 3, 207)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([PARENTS, range(24)]).astype(np.uint32),
        "f": rng.integers(0, 40, (70, 3)).astype(np.uint32),
    }


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory) -> Path:
    """A capture of twelve frames, 64 px high."""
    folder = tmp_path_factory.mktemp("small") / "capture"
    film_capture(folder, ShootConfig(frames=12, size=64))
    return folder


@pytest.fixture
def motion(rng) -> Motion:
    """Six small poses."""
    roots, places = 0.3 * rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    joints = 0.3 * rng.normal(size=(6, 23, 3))
    return make_motion(roots, places, joints, betas=rng.normal(size=10))


@pytest.fixture
def truth(rng) -> Motion:
    """Forty poses of a person who turns round and waves, 3 m before a camera, y down."""
    count = 40
    phase = np.linspace(0.0, 2.0 * np.pi, count)
    yaw = phase[:, None] * np.array([0.0, 1.0, 0.0])
    upright = np.array([np.pi, 0.0, 0.0])
    roots = (Rotation.from_rotvec(upright) * Rotation.from_rotvec(yaw)).as_rotvec()
    waves = 0.4 * np.sin(phase[:, None, None] + rng.uniform(0.0, 6.0, (1, 23, 3)))
    waves[:, 21:] = 0.0  # SMPL's hands: no tracker knows more of them
    places = np.column_stack([0.3 * np.sin(phase), 0.2 + 0.0 * phase, 3.0 + 0.4 * np.cos(phase)])
    betas = 0.5 * rng.normal(size=10)
    return make_motion(roots, places, waves, "smpl", betas=betas, frames=np.arange(count))


@pytest.fixture
def joints_of(shaped) -> Callable[..., np.ndarray]:
    """Posed joints of every row of a motion, metres."""
    return lambda motion: posed_joints(motion, shaped)


@pytest.fixture(scope="session", autouse=True)
def one_proportion_space_per_body():
    """The same space for equal bodies, which takes a quarter of a second."""
    make_space, spaces = ProportionSpace.around, {}

    def space_around(shaped: ShapedBody) -> ProportionSpace:
        key = tuple(a.tobytes() for a in (shaped.vertices, shaped.joints, shaped.body.weights))
        if key not in spaces:
            spaces[key] = make_space(shaped)
        return spaces[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ProportionSpace, "around", space_around)
        yield


@pytest.fixture
def one_iteration(monkeypatch) -> None:
    """Fits iterate once over key points, and once with outlines."""
    stages = ClipFitter.iterate_stages
    once = lambda fitter, fitted, *counts, **named: stages(fitter, fitted, 1, 1)  # noqa: E731
    monkeypatch.setattr(ClipFitter, "iterate_stages", once)


@pytest.fixture
def joblib_bytes(monkeypatch) -> Callable[..., bytes]:
    """What joblib 1.x writes: arrays lie between the opcodes, aligned to 16 bytes."""
    module = types.ModuleType("joblib.numpy_pickle")

    class NumpyArrayWrapper:
        def __init__(self, array):
            self.subclass = np.ndarray
            self.shape = array.shape
            self.order = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
            self.dtype = array.dtype
            self.allow_mmap = not array.dtype.hasobject
            self.numpy_array_alignment_bytes = 16

    NumpyArrayWrapper.__module__ = "joblib.numpy_pickle"
    NumpyArrayWrapper.__qualname__ = "NumpyArrayWrapper"
    module.NumpyArrayWrapper = NumpyArrayWrapper
    monkeypatch.setitem(sys.modules, "joblib", types.ModuleType("joblib"))
    monkeypatch.setitem(sys.modules, "joblib.numpy_pickle", module)

    class JoblibPickler(pickle._Pickler):
        def __init__(self, stream, protocol):
            super().__init__(stream, protocol)
            self.stream = stream

        def save(self, obj, save_persistent_id=True):
            if type(obj) is not np.ndarray:
                return super().save(obj, save_persistent_id)
            super().save(NumpyArrayWrapper(obj))
            if self.proto >= 4:
                self.framer.commit_frame(force=True)
            if obj.dtype.hasobject:
                pickle.dump(obj, self.stream, protocol=2)
            else:
                padding = 16 - (self.stream.tell() + 1) % 16
                self.stream.write(bytes([padding]) + b"\xff" * padding)
                self.stream.write(obj.tobytes("A"))
            return None

    def dump(thing, *, compressed: bool = False, protocol: int = 4) -> bytes:
        stream = io.BytesIO()
        JoblibPickler(stream, protocol).dump(thing)
        return zlib.compress(stream.getvalue(), 3) if compressed else stream.getvalue()

    return dump


@pytest.fixture(scope="session")
def keypoint_camera() -> Camera:
    """A phone's camera at the origin."""
    return Camera(
        focal_px=(204.0, 204.0), center_px=(67.5, 120.0), size_px=(135, 240),
        camera_from_world=np.eye(4),
    )  # fmt: skip


@pytest.fixture(scope="session")
def turning_person() -> Callable[[int], Motion]:
    """Makes a person who turns round before the camera, with bent arms and knees; 10° a frame."""

    def turning_person(count: int) -> Motion:
        yaw = np.deg2rad(10.0) * np.arange(count)[:, None] * np.array([0.0, 1.0, 0.0])
        roots = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec(yaw)
        joints = np.zeros((count, 23, 3))
        joints[:, [0, 1], 0], joints[:, [3, 4], 0] = -0.3, 0.5  # hips and knees
        joints[:, 15], joints[:, 16] = (0.0, 0.0, -0.9), (0.0, 0.0, 0.9)  # shoulders
        joints[:, 17, 1], joints[:, 18, 1] = -0.8, 0.8  # elbows
        places = np.tile([0.0, 0.2, 3.0], (count, 1))
        return make_motion(roots.as_rotvec(), places, joints, frames=np.arange(count))

    return turning_person


@pytest.fixture(scope="session")
def track_motion(shaped, keypoint_camera) -> Callable[[Motion], KeypointTrack]:
    """Makes the key points that a perfect tracker would find of a motion."""
    return lambda motion: perfect_track(motion, shaped, keypoint_camera)
