"""Pose files of other programs in SMPL's angles: trackers, studios and data sets.

One `parse_…` a program: the people of a file's content by their names, or None if it is another's.
Trackers follow people through a video, in the camera of each frame; `prefer_world` reads poses in
the world, where the program knows them, to drive an avatar. Those of EasyMocap and ZJU-MoCap (a
json a frame), SLAHMR and 3DPW (several people in one array, with the cameras) and motion capture to
drive an avatar (AMASS, AIST++) are in a world.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.camera import Matrix3, Vector3
from preprocess.body.body_pose import DIAGONAL_FOCAL, Motion, RelativeFocalLength
from preprocess.body.kinematics import rigid_transform
from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion, stack_rows

GVHMR_VIEWS = ("smpl_params_incam", "smpl_params_global")
PROMPTHMR_VIEWS = ("smplx_cam", "smplx_world")
"""Keys of the poses in the camera and in the world."""
TRAM_KEYS = {"pred_rotmat", "pred_trans", "frame"}
"""Keys by which a file of TRAM is recognised."""
EASYMOCAP_KEYS = {"Rh", "Th", "poses"}
"""Keys by which a file of EasyMocap is recognised."""


def _hold_keys(people: Any, keys: set[str]) -> bool:
    return (
        isinstance(people, dict)
        and len(people) > 0
        and all(isinstance(rows, dict) and keys <= rows.keys() for rows in people.values())
    )


def _choose_view(rows: dict[str, Any], views: tuple[str, str], prefer_world: bool) -> str:
    return next(key for key in (views[::-1] if prefer_world else views) if key in rows)


def parse_wham(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """WHAM: axis-angles in the camera and in a world with y up, by person.

    Layout: joblib `wham_output.pkl` {person: {pose (N, 72), trans (N, 3), pose_world, trans_world,
    betas (N, 10), verts, frame_ids (N,)}}. Its focal length, if none was given, is the image's
    diagonal, and is not stored. (github.com/yohanshin/WHAM, demo.py.)
    """
    if not _hold_keys(content, {"pose", "trans", "frame_ids"}):
        return None
    people = {}
    for person, rows in content.items():
        in_world = prefer_world and "pose_world" in rows
        end = "_world" if in_world else ""
        people[str(person)] = build_motion(
            [rows["pose" + end]],
            rows["trans" + end],
            betas=rows.get("betas"),
            frames=rows["frame_ids"],
            space="world" if in_world else "camera",
            lens=None if in_world else DIAGONAL_FOCAL,
        )
    return people


def parse_vibe(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """VIBE: axis-angles and a weak-perspective camera of the whole image, by person.

    Layout: joblib `vibe_output.pkl` {person: {pose (N, 72), betas (N, 10), orig_cam (N, 4) = (sx,
    sy, tx, ty), pred_cam, bboxes (N, 4), verts, frame_ids (N,)}}: a point (X, Y) of the body is
    drawn at sx (X + tx), sy (Y + ty) in units of half the width and half the height.
    (github.com/mkocabas/VIBE, demo.py and lib/utils/demo_utils.py.)
    """
    if not _hold_keys(content, {"pose", "orig_cam", "frame_ids"}):
        return None
    # any would do: weak perspective has none, and the depth follows from it
    people, phone = {}, RelativeFocalLength(ratio=0.85)
    for person, rows in content.items():
        across, down, x, y = np.asarray(rows["orig_cam"], dtype=np.float64).T
        # focal / depth = sx width / 2, and width : height = sy : sx
        longer_per_width = np.maximum(1.0, across / down)
        depth = 2.0 * phone.ratio * longer_per_width / across
        people[str(person)] = build_motion(
            [rows["pose"]],
            np.column_stack([x, y, depth]),
            betas=rows.get("betas"),
            frames=rows["frame_ids"],
            lens=phone,
        )
    return people


def parse_gvhmr(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """GVHMR: an SMPL-X body of one person in the camera and in a world with y up.

    Layout: torch `hmr4d_results.pt` {smpl_params_incam, smpl_params_global: {body_pose (L, 63),
    global_orient (L, 3), transl (L, 3), betas (L, 10)}, K_fullimg (L, 3, 3), net_outputs}. Rows are
    all frames of `0_input_video.mp4`, its own copy of the video, so they belong to frames by order.
    (github.com/zju3dv/GVHMR, tools/demo/demo.py.)
    """
    if not isinstance(content, dict) or not set(GVHMR_VIEWS) & content.keys():
        return None
    view = _choose_view(content, GVHMR_VIEWS, prefer_world)
    rows, in_camera = content[view], view == GVHMR_VIEWS[0]
    person = build_motion(
        [rows["global_orient"], rows["body_pose"]],
        rows["transl"],
        betas=rows.get("betas"),
        body_model="smplx",
        space="camera" if in_camera else "world",
        lens=content.get("K_fullimg") if in_camera else None,
    )
    return {"0": person}


def parse_prompthmr(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """PromptHMR: SMPL-X bodies by person, in the camera and in the world.

    Layout: `results.pkl` {people: {person: {frames (N,), smplx_cam, smplx_world: {rotmat (N, 55, 3,
    3) or pose (N, 165), shape (N, 10), trans (N, 3)}}}, camera: {img_focal, img_center, …}}.
    Images were shrunk to a height of 896 px at most: K belongs to these.
    (github.com/yufu-wang/PromptHMR.)
    """
    tracks: Any = content.get("people") if isinstance(content, dict) else None
    if not _hold_keys(tracks, set()) or not all(
        set(PROMPTHMR_VIEWS) & rows.keys() for rows in tracks.values()
    ):
        return None
    intrinsic = _tram_intrinsic(content.get("camera"))
    people = {}
    for name, rows in tracks.items():
        view = _choose_view(rows, PROMPTHMR_VIEWS, prefer_world)
        body, in_camera = rows[view], view == PROMPTHMR_VIEWS[0]
        people[str(name)] = build_motion(
            [body["rotmat"] if "rotmat" in body else body["pose"]],
            body["trans"],
            betas=body.get("shape"),
            frames=rows["frames"],
            body_model="smplx",
            space="camera" if in_camera else "world",
            lens=intrinsic if in_camera else None,
        )
    return people


def parse_tram(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """TRAM: rotation matrices by person, each in a file of its own, beside the camera's file.

    Layout: `hps/hps_track_K.npy`, a pickled {pred_rotmat (N, 24, 3, 3), pred_shape (N, 10),
    pred_trans (N, 1, 3), pred_cam, frame (N,)} of torch tensors, metres in the camera; `camera.npy`
    {img_focal, img_center, world_cam_R, world_cam_T, …}. Give one track, the folder `hps`, or the
    folder above. (github.com/yufu-wang/tram, scripts/estimate_humans.py and visualize_tram.)
    """
    if not isinstance(content, dict):
        return None
    if content.keys() >= TRAM_KEYS:
        return {"0": _tram_person(content, None)}
    tracks = {
        (re.findall(r"\d+", name) or [name])[-1]: rows
        for name, rows in content.items()
        if isinstance(rows, dict) and rows.keys() >= TRAM_KEYS
    }
    camera = content.get("camera.npy")
    return {person: _tram_person(rows, camera) for person, rows in tracks.items()} or None


def _tram_person(rows: dict[str, Any], camera: Any) -> Motion:
    return build_motion(
        [rows["pred_rotmat"]],
        np.reshape(rows["pred_trans"], (-1, 3)),
        betas=rows.get("pred_shape"),
        frames=rows["frame"],
        lens=_tram_intrinsic(camera if isinstance(camera, dict) else rows),
    )


def _tram_intrinsic(held: Any) -> Matrix3 | None:
    """Camera matrix K of `img_focal` and `img_center`; None where one is missing."""
    if not isinstance(held, dict) or held.get("img_focal") is None:
        return None
    if held.get("img_center") is None:
        return None
    f = float(np.asarray(held["img_focal"]).reshape(-1)[0])
    x, y = np.asarray(held["img_center"]).reshape(-1)[:2]
    return np.array([[f, 0.0, float(x)], [0.0, f, float(y)], [0.0, 0.0, 1.0]])


def parse_phalp(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """4D-Humans and PHALP: rotation matrices of everybody in each frame, in a camera of 5,000 px.

    Layout: a joblib file {image: {time, tid, tracked_ids, tracked_time, size, camera, smpl, …}};
    the lists run in parallel, `smpl[k]` = {global_orient (1, 3, 3), body_pose (23, 3, 3), betas
    (10,)}, `camera[k]` = (3,), metres for a focal length of 5,000 px on a padded square of 256 px.
    A track that was not detected in a frame is in its lists as a guess: `tracked_time[k]` > 0.
    (github.com/brjathu/PHALP, phalp/trackers/PHALP.py.)
    """
    if not _hold_keys(content, {"smpl", "tid"}):
        return None
    people: dict[str, list[tuple[int, Any, Any]]] = {}
    for place, frame in enumerate(content.values()):
        unseen = frame.get("tracked_time", [0] * len(frame["tid"]))
        number = int(frame.get("time", place))
        for row, person in enumerate(frame["tid"]):
            if not unseen[row]:
                seen = (number, frame["smpl"][row], frame["camera"][row])
                people.setdefault(str(int(person)), []).append(seen)
    return {person: _phalp_person(rows) for person, rows in people.items()}


def _phalp_person(rows: list[tuple[int, Any, Any]]) -> Motion:
    poses = [smpl for _, smpl, _ in rows]
    return build_motion(
        [
            stack_rows([np.reshape(pose["global_orient"], (1, 3, 3)) for pose in poses]),
            stack_rows([np.reshape(pose["body_pose"], (-1, 3, 3)) for pose in poses]),
        ],
        stack_rows([np.reshape(camera, 3) for _, _, camera in rows]),
        betas=stack_rows([np.reshape(pose["betas"], -1) for pose in poses]),
        frames=[number for number, _, _ in rows],
        lens=RelativeFocalLength(ratio=5000.0 / 256.0),  # 5,000 px on a square of 256 px
    )


def parse_romp(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """ROMP and BEV (simple-romp): all people of each frame, with or without tracks.

    Layout: `video_results.npz` with `results` {image: {smpl_thetas (P, 72), smpl_betas (P, 10 or
    11), cam (P, 3), cam_trans (P, 3), pj2d, pj2d_org, …}} and, tracked with -t, `sequence_results`
    {track: {frame_id: […], smpl_thetas: […], …}}; or a folder of one .npz a frame, each with its
    `results`. (github.com/Arthur151/ROMP, simple_romp: romp/main.py, bev/main.py, romp/utils.py.)
    """
    if not isinstance(content, dict):
        return None
    content = content.get("video_results.npz", content)  # a folder with everything in it
    sequence = content.get("sequence_results")
    if isinstance(sequence, dict) and sequence:
        return {
            str(person): _romp_person(rows, rows["frame_id"])
            for person, rows in sequence.items()
            if len(rows["frame_id"])
        }
    results = content.get("results")
    if isinstance(results, dict) and "smpl_thetas" in results:
        return _link_people([results], [0])
    if isinstance(results, dict) and results:
        return _link_people(list(results.values()), range(len(results)))
    if content and all(_is_romp_frame(part) for part in content.values()):
        frames = [part["results"] for part in content.values()]
        return _link_people(frames, frame_numbers_from_names(content))
    return None


def _is_romp_frame(part: Any) -> bool:
    held = part.get("results") if isinstance(part, dict) else None
    return isinstance(held, dict) and "smpl_thetas" in held


def _romp_person(rows: dict[str, Any], frames: Any) -> Motion:
    thetas, places = stack_rows(list(rows["smpl_thetas"])), stack_rows(list(rows["cam_trans"]))
    betas = stack_rows(list(rows["smpl_betas"]))
    is_bev = betas.shape[-1] == 11
    lens = RelativeFocalLength(ratio=443.4 / 512.0)  # 60 degrees over the padded square
    if not is_bev and "cam" in rows:
        scales = stack_rows(list(rows["cam"]))[:, 0]
        if np.allclose(places[:, 2] * scales, 2.0, rtol=1e-3):
            lens = RelativeFocalLength(ratio=1.0)  # z = 2 / s puts a point where it was seen
    return build_motion(
        [thetas], places, betas=betas[:, :10], frames=frames, lens=lens,
        lost=places[:, 2] <= 0.0,  # (-1, -1, -1) where their perspective fit has failed
        anchor="hips" if is_bev else "pelvis",
    )  # fmt: skip


def _link_people(frames: list[dict[str, Any]], numbers: Any) -> MotionByPerson:
    """People of each frame joined with those of the frames before: by number, else by place."""
    people: dict[str, dict[str, Any]] = {}
    last: dict[str, Float[np.ndarray, 3]] = {}
    for number, frame in zip(numbers, frames, strict=True):
        places = np.asarray(frame["cam_trans"], dtype=np.float64).reshape(-1, 3)
        names = frame.get("track_ids")
        taken: set[str] = set()
        for row, place in enumerate(places):
            if names is not None:
                name = str(int(np.asarray(names).reshape(-1)[row]))
            else:
                name = nearest_person(place, last, taken) or str(len(people))
            taken.add(name)
            person = people.setdefault(name, {"frame_id": []})
            person["frame_id"].append(number)
            last[name] = place
            for key in ("smpl_thetas", "smpl_betas", "cam_trans", "cam"):
                if key in frame:
                    person.setdefault(key, []).append(np.asarray(frame[key])[row])
    return {name: _romp_person(rows, rows["frame_id"]) for name, rows in people.items()}


def nearest_person(place: Vector3, last: dict[str, Vector3], taken: set[str]) -> str | None:
    """The nearest person of the frames before; depth counts a third: it is the least certain."""
    gaps = {
        name: float(np.linalg.norm((place - before) * np.array([1.0, 1.0, 1.0 / 3.0])))
        for name, before in last.items()
        if name not in taken
    }
    name = min(gaps, key=lambda known: gaps[known], default=None)
    return name if name is not None and gaps[name] < 1.0 else None  # metres from frame to frame


def parse_amass(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Motion capture: AMASS (SMPL+H, SMPL-X) and AIST++.

    Layout, AMASS: .npz with poses (N, 156) = root, 21 body joints, hands; trans (N, 3), betas
    (16,), gender, mocap_framerate; newer `*_stageii.npz`: root_orient (N, 3), pose_body (N, 63),
    trans, betas, mocap_frame_rate, surface_model_type. World with z up. AIST++: pickle with
    smpl_poses (N, 72) or (N, 24, 3), smpl_scaling (1,), smpl_trans (N, 3) in units of the scaling,
    60 rows a second. (amass.is.tue.mpg.de; github.com/google/aistplusplus_api, loader.py.)
    """
    if not isinstance(content, dict):
        return None
    if {"smpl_poses", "smpl_trans"} <= content.keys():
        return {"0": _aist_motion(content)}
    if {"root_orient", "pose_body", "trans"} <= content.keys():
        parts = [content["root_orient"], content["pose_body"]]
    elif {"poses", "trans"} <= content.keys() and _rate(content) is not None:
        parts = [content["poses"]]
    else:
        return None
    rate = _rate(content)
    model = str(content.get("surface_model_type", "smpl"))
    numbers = sum(np.asarray(part).size for part in parts) / max(1, len(content["trans"]))
    is_smplx = "smplx" in model.replace("-", "").lower() or numbers == 165  # 55 joints
    motion = build_motion(
        parts,
        content["trans"],
        betas=np.asarray(content["betas"], dtype=np.float64).reshape(-1)[:10]
        if "betas" in content
        else None,
        times_s=None if rate is None else np.arange(len(np.asarray(content["trans"]))) / rate,
        body_model="smplx" if is_smplx else "smpl",
        space="world",
    )
    return {"0": motion}


def _aist_motion(content: dict[str, Any]) -> Motion:
    places = np.asarray(content["smpl_trans"], dtype=np.float64)
    scaling = float(np.asarray(content.get("smpl_scaling", 1.0)).reshape(-1)[0])
    if not np.isfinite(scaling) or scaling <= 0.0:
        raise ValueError(f"`smpl_scaling` of {scaling}")
    poses = np.asarray(content["smpl_poses"], dtype=np.float64).reshape(len(places), -1)
    times_s = np.arange(len(places)) / 60.0  # by their documentation
    return build_motion([poses], places / scaling, times_s=times_s, space="world")


def _rate(content: dict[str, Any]) -> float | None:
    keys = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
    found = next((content[key] for key in keys if key in content), None)
    rate = None if found is None else float(np.asarray(found).reshape(-1)[0])
    return rate if rate is not None and np.isfinite(rate) and rate > 0.0 else None


def parse_easymocap(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """EasyMocap and ZJU-MoCap: a json a frame, and a rotation about the origin, not the pelvis.

    Layout: a folder of `000000.json` …, each a list of {id, Rh (1, 3), Th (1, 3), poses (1, 72)
    whose first three are 0 (or 63, 69, 87 numbers), shapes (1, 10)}, or {annots: that list}.
    ZJU-MoCap's `new_params/0.npy` hold one of these each. World: the calibrated cameras'
    (extri.yml). V = R(Rh) LBS(poses) + Th.
    (github.com/zju3dv/EasyMocap, easymocap/mytools/file_utils.py.)
    """
    files = content if isinstance(content, dict) else {"0": content}
    if files.keys() >= EASYMOCAP_KEYS:
        files = {"0": content}
    frames = {name: _easymocap_people(held) for name, held in files.items()}
    if not frames or any(people is None for people in frames.values()):
        return None
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for number, people in zip(frame_numbers_from_names(frames), frames.values(), strict=True):
        for person in people or ():
            name = str(person.get("id", person.get("personID", 0)))
            found.setdefault(name, []).append((number, person))
    return {name: _easymocap_motion(rows) for name, rows in found.items()} or None


def _easymocap_people(held: Any) -> list[dict[str, Any]] | None:
    if isinstance(held, dict) and "annots" in held:
        held = held["annots"]
    listed = [held] if isinstance(held, dict) else held
    if not isinstance(listed, list) or not all(
        isinstance(person, dict) and person.keys() >= EASYMOCAP_KEYS for person in listed
    ):
        return None
    return listed


def _easymocap_motion(rows: list[tuple[int, dict[str, Any]]]) -> Motion:
    people = [person for _, person in rows]
    return build_motion(
        [
            stack_rows([np.reshape(p["Rh"], 3) for p in people]),
            stack_rows([_easymocap_joints(p) for p in people]),
        ],
        stack_rows([np.reshape(p["Th"], 3) for p in people]),
        betas=stack_rows([np.reshape(p["shapes"], -1)[:10] for p in people])
        if all("shapes" in person for person in people)
        else None,
        frames=[number for number, _ in rows],
        space="world",
        anchor="origin",
    )


def _easymocap_joints(person: dict[str, Any]) -> Float[np.ndarray, "numbers"]:
    """The rotations of the joints but the root; 72 and 66 numbers begin with the root at rest."""
    numbers = np.asarray(person["poses"], dtype=np.float64).reshape(-1)
    if len(numbers) in (66, 72, 78, 87, 156, 165):
        if np.abs(numbers[:3]).max() > 1e-6:
            raise ValueError("`poses` turn the root although `Rh` does; expected its first 3 at 0")
        return numbers[3:72] if len(numbers) == 72 else numbers[3:66]
    return numbers if len(numbers) == 69 else numbers[:63]


def parse_slahmr(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Several people in one array, with the file's own cameras: SLAHMR, its successors, and 3DPW.

    Layout: SLAHMR's `*_world_results.npz` {trans (P, N, 3), root_orient (P, N, 3), pose_body
    (P, N, 63), betas (P, 16), cam_R (P, N, 3, 3) and cam_t (P, N, 3) camera-from-world, intrins
    (4,) = fx fy cx cy, perhaps track_mask (P, N)}, metres; 3DPW's pickle {poses [(N, 72)], trans
    [(N, 3)], betas, cam_poses (N, 4, 4), cam_intrinsics}. (github.com/vye16/slahmr,
    optim/output.py; 3DPW's readme.)
    """
    if not isinstance(content, dict):
        return None
    if content.keys() >= {"poses", "trans", "cam_poses", "cam_intrinsics"}:
        rows = zip(content["poses"], content["trans"], strict=True)
        shapes = content.get("betas") or [None] * len(content["trans"])
        cameras = np.asarray(content["cam_poses"], dtype=np.float64)
        intrinsic = np.asarray(content["cam_intrinsics"], dtype=np.float64)
        return {
            str(number): _with_cameras(
                build_motion([poses], places, betas=shape, space="world", lens=intrinsic), cameras
            )
            for number, ((poses, places), shape) in enumerate(zip(rows, shapes, strict=True))
        }
    if (
        not content.keys() >= {"root_orient", "pose_body", "trans"}
        or np.ndim(content["trans"]) != 3
    ):
        return None
    return {str(number): _slahmr_motion(content, number) for number in range(len(content["trans"]))}


def _slahmr_motion(content: dict[str, Any], number: int) -> Motion:
    intrinsic = None
    if "intrins" in content:
        fx, fy, cx, cy = np.asarray(content["intrins"], dtype=np.float64).reshape(-1, 4)[0]
        intrinsic = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    found = build_motion(
        [content["root_orient"][number], content["pose_body"][number]],
        content["trans"][number],
        betas=np.asarray(content["betas"], dtype=np.float64)[number][..., :10]
        if "betas" in content
        else None,
        lost=~np.asarray(content["track_mask"], dtype=bool)[number]
        if "track_mask" in content
        else None,
        space="world",
        lens=intrinsic,
    )
    if not {"cam_R", "cam_t"} <= content.keys():
        return found
    turns, shifts = (np.asarray(content[key], dtype=np.float64) for key in ("cam_R", "cam_t"))
    cameras = rigid_transform(
        turns[number] if turns.ndim == 4 else turns, shifts[number] if shifts.ndim == 3 else shifts
    )
    return _with_cameras(found, cameras)


def _with_cameras(motion: Motion, cameras: np.ndarray) -> Motion:
    if cameras.shape != (len(motion), 4, 4) or not np.isfinite(cameras).all():
        raise ValueError(f"cameras of the shape {cameras.shape} for {len(motion)} poses")
    return replace(motion, camera_from_world=cameras)
