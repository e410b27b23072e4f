"""Small whole files of every kind that is read, from which hostile ones are made."""

import gzip
import io
import json
import pickle
import shutil
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.source_opening import open_source
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.parametric_body import load_body_model, write_shaped_body
from preprocess.masks.mask_files import open_masks

ROWS, SIDE = 6, 64


def make_seeds(folder: Path) -> None:
    """Writes a folder for each reader, with files (or folders) whose names are theirs."""
    film = folder / "captures" / "film"
    film_capture(film, ShootConfig(frames=ROWS, size=SIDE, background="plain"))
    (film / "dance.npz").unlink(missing_ok=True)
    shutil.rmtree(film / "truth", ignore_errors=True)
    alpha = folder / "captures" / "alpha"
    (alpha / "images").mkdir(parents=True)
    masks = open_masks(film / "masks")
    for frame in open_source(film).frames():
        rgba = np.dstack([frame.rgb, (255 * masks.alpha(frame.index, frame.size_px)).round()])
        place = alpha / "images" / f"{frame.index}.png"
        cv2.imwrite(str(place), cv2.cvtColor(rgba.astype(np.uint8), cv2.COLOR_RGBA2BGRA))
    for name in ("poses.npz", "cameras.npz"):
        shutil.copy(film / name, alpha / name)
    _poses(_made(folder / "poses"), film)
    _pickles(_made(folder / "pickles"))
    _masks(_made(folder / "masks"), film)
    _cameras(_made(folder / "cameras"), film)
    _bodies(_made(folder / "bodies"))
    pictures = _made(folder / "pictures")
    shutil.copy(film / "video.mp4", pictures / "video.mp4")
    frame = next(iter(open_source(film).frames()))
    for ending in ("png", "jpg", "webp", "tif", "bmp"):
        cv2.imwrite(str(pictures / f"picture.{ending}"), frame.rgb)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def npz_bytes(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def npy_bytes(thing: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, thing, allow_pickle=True)
    return stream.getvalue()


def torch_bytes(thing: Any, *, new: bool = True) -> bytes:
    import torch

    stream = io.BytesIO()
    torch.save(thing, stream, _use_new_zipfile_serialization=new)
    return stream.getvalue()


def _poses(folder: Path, film: Path) -> None:
    """What trackers write."""
    import torch

    shutil.copy(film / "poses.npz", folder / "poses.npz")
    theta, place = np.full((ROWS, 72), 0.1, np.float32), np.tile(np.float32([0, 0, 3]), (ROWS, 1))
    betas, frames = np.zeros((ROWS, 10), np.float32), np.arange(ROWS)
    turn = np.tile(np.eye(3, dtype=np.float32), (ROWS, 24, 1, 1))
    wham = {0: {"pose": theta, "trans": place, "betas": betas, "frame_ids": frames}}
    camera = np.tile([0.8, 0.8, 0.1, 0.2], (ROWS, 1))
    vibe = {1: {"pose": theta, "orig_cam": camera, "betas": betas, "frame_ids": frames}}
    phalp = {
        f"img/{row:06d}.jpg": {
            "time": row, "tid": [1], "tracked_ids": [1], "size": [[SIDE, SIDE]],
            "smpl": [{"global_orient": turn[row, :1], "body_pose": turn[row, 1:],
                      "betas": betas[row]}],
            "camera": [place[row]], "mask": [{"size": [SIDE, SIDE], "counts": b"0"}],
        }
        for row in range(ROWS)
    }  # fmt: skip
    view = {"body_pose": torch.tensor(theta[:, 3:66]), "global_orient": torch.tensor(theta[:, :3])}
    view |= {"transl": torch.tensor(place), "betas": torch.zeros(ROWS, 10)}
    gvhmr = {"smpl_params_incam": view, "smpl_params_global": view,
             "K_fullimg": torch.eye(3).expand(ROWS, 3, 3)}  # fmt: skip
    tram = {"pred_rotmat": torch.tensor(turn), "pred_trans": torch.tensor(place)[:, None],
            "pred_shape": torch.tensor(betas), "frame": torch.arange(ROWS)}  # fmt: skip
    body = {"rotmat": np.tile(np.eye(3), (ROWS, 55, 1, 1)), "shape": betas, "trans": place}
    prompt = {"people": {1: {"frames": frames, "smplx_cam": body, "smplx_world": body}},
              "camera": {"img_focal": 500.0, "img_center": np.array([32.0, 32.0])}}  # fmt: skip
    romp = {5: {"frame_id": list(range(ROWS)), "smpl_thetas": list(theta),
                "smpl_betas": list(betas), "cam_trans": list(place)}}  # fmt: skip
    files = {
        "wham.pkl": pickle.dumps(wham, 4), "vibe.pkl": pickle.dumps(vibe, 2),
        "phalp.pkl": zlib.compress(pickle.dumps(phalp, 3)), "gvhmr.pt": torch_bytes(gvhmr),
        "tram.npy": npy_bytes(tram), "prompthmr.pkl": pickle.dumps(prompt),
        "romp.npz": npz_bytes(results=np.array({}, dtype=object),
                        sequence_results=np.array(romp, dtype=object)),
        "amass.npz": npz_bytes(poses=np.zeros((ROWS, 156)), trans=place, betas=np.zeros(16),
                         mocap_framerate=np.array(120.0)),
        "aist.pkl": pickle.dumps({"smpl_poses": theta, "smpl_scaling": np.float32([93.0]),
                                  "smpl_trans": place}, 2),
        "slahmr.npz": npz_bytes(trans=place[None], root_orient=theta[None, :, :3],
                          pose_body=theta[None, :, 3:66], betas=betas[:1],
                          cam_R=turn[None, :, 0], cam_t=place[None], intrins=np.ones(4)),
        "emdb.pkl": pickle.dumps({"gender": "male", "camera": {"intrinsics": np.eye(3)},
                                  "smpl": {"poses_root": theta[:, :3], "trans": place,
                                           "poses_body": theta[:, 3:], "betas": betas[0]}}),
        "frames.json": json.dumps([{"root_pose": [0, 0, 0], "body_pose": [[0, 0, 0]] * 21,
                                    "trans": [0, 0, 3]}] * ROWS).encode(),
        "person.json": json.dumps([{"id": 0, "Rh": [[0, 0, 1]], "Th": [[0, 0, 3]],
                                    "poses": [[0] * 72], "shapes": [[0] * 10]}]).encode(),
    }  # fmt: skip
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _pickles(folder: Path) -> None:
    """Every container that can hold a pickle."""
    import torch

    plain = {"a": np.arange(6.0).reshape(2, 3), "l": [1, 2.5, "x", None, (True,)], "s": {1, 2}}
    tensors = {**plain, "t": torch.ones(2, 3)}
    numbers = {**tensors, "a": torch.ones(3, 2).T}
    files = {f"protocol{n}.pkl": pickle.dumps(plain, n) for n in range(6)}
    files |= {"zlib.pkl": zlib.compress(pickle.dumps(plain)), "object.npy": npy_bytes(tensors)}
    files |= {"gzip.pkl": gzip.compress(pickle.dumps(plain)), "new.pt": torch_bytes(numbers)}
    files |= {"old.pt": torch_bytes(numbers, new=False)}
    files |= {"object.npz": npz_bytes(results=np.array({"deep": plain}, dtype=object))}
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _masks(folder: Path, film: Path) -> None:
    """Everything that holds masks."""
    masks = open_masks(film / "masks")
    stack = np.stack([masks.alpha(row, masks.size_px) > 0.5 for row in range(masks.count)])
    files = {"masks.npz": npz_bytes(masks=stack), "masks.npy": npy_bytes(stack.astype(np.uint8))}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    shutil.copy(sorted((film / "masks").iterdir())[0], folder / "mask.png")
    writer = cv2.VideoWriter(
        str(folder / "masks.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (SIDE, SIDE)
    )
    for mask in stack:
        writer.write(np.repeat(255 * mask[..., None].astype(np.uint8), 3, axis=2))
    writer.release()


def _cameras(folder: Path, film: Path) -> None:
    """Cameras of every program that is known."""
    import pycolmap

    shutil.copy(film / "cameras.npz", folder / "cameras.npz")
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": pose} for n in range(ROWS)]
    lens = {"w": SIDE, "h": SIDE, "fl_x": 50.0, "cx": 32.0, "cy": 32.0}
    record = {"poses": [[0, 0, 0, 1, 0, 0, 0]] * ROWS, "K": [50, 0, 0, 0, 50, 0, 32, 32, 1],
              "w": SIDE, "h": SIDE, "fps": 30}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    with zipfile.ZipFile(folder / "record.r3d", "w") as archive:
        archive.writestr("metadata.json", json.dumps(record))
        archive.writestr("metadata", json.dumps(record))
    numbers: dict[str, float] = {f"t_{r}{c}": float(r == c) for r in range(3) for c in range(4)}
    numbers |= {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 32.0, "width": SIDE, "height": SIDE}
    for number in range(ROWS):
        place = folder / "polycam" / "keyframes" / "cameras" / f"{number}.json"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(json.dumps(numbers))
    studio = _made(folder / "studio")
    for file, parts in (("intri", {"K": 50.0 * np.eye(3)}), ("extri", {"Rot": np.eye(3),
                        "T": np.zeros((3, 1))})):  # fmt: skip
        storage = cv2.FileStorage(str(studio / f"{file}.yml"), cv2.FileStorage_WRITE)
        for key, matrix in parts.items():
            storage.write(f"{key}_1", matrix)
        storage.release()
    rig = {"K": [50.0 * np.eye(3)], "D": [np.zeros((5, 1))], "R": [np.eye(3)],
           "T": [np.zeros((3, 1))]}  # fmt: skip
    zju = {"cams": rig, "ims": [{"ims": ["Camera_B1/000000.jpg"]}]}
    (folder / "annots.npy").write_bytes(npy_bytes(np.array(zju, dtype=object)))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE", width=SIDE, height=SIDE, params=(50.0, 50.0, 32.0, 32.0), camera_id=1
        )
    )
    for number in range(1, ROWS + 1):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
    model.write_binary(_made(folder / "binary"))
    model.write_text(_made(folder / "text"))


def _bodies(folder: Path) -> None:
    """A body of few vertices, in both containers; and an avatar's person."""
    body = load_body_model()
    few = np.linspace(0, len(body.template) - 1, 60).astype(int)
    arrays = {
        "v_template": body.template[few], "shapedirs": body.shape_directions[few],
        "weights": body.weights[few], "f": np.arange(60).reshape(-1, 3).astype(np.uint32),
        "kintree_table": np.stack([body.parents, np.arange(24)]),
    }  # fmt: skip
    regressor = np.full((24, 60), 1.0 / 60.0)
    (folder / "body.npz").write_bytes(
        npz_bytes(**arrays, J=body.joints, J_shapedirs=body.joint_directions)
    )
    (folder / "SMPL.pkl").write_bytes(pickle.dumps({**arrays, "J_regressor": regressor}, 2))
    write_shaped_body(folder / "person.npz", body.with_shape())
