"""Hostile files and thousands of random ones are read, or refused with a reason, and run nothing.

Every run tries a few hundred; `IA_FUZZ=10000 pytest tests/preprocess/poses -k random` tries
more, and benchmarks.fuzz_readers tries every reader.
"""

import gzip
import io
import json
import os
import pickle
import sys
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.fuzz_mutations import mutate_bytes, random_opcodes
from capture.input_error import InputError
from preprocess import file_content
from preprocess.body.parametric_body import load_body_model
from preprocess.file_content import read_untrusted_file
from preprocess.poses.pose_format_registry import read_poses

FILES = int(os.environ.get("IA_FUZZ", "300"))
FORBIDDEN = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.remove", "os.rename",
    "os.rmdir", "shutil.", "subprocess.", "socket.", "ctypes.", "webbrowser.",
)  # fmt: skip
_seen: list[str] = []
_watching = False


def _audit(event: str, arguments: tuple) -> None:
    if _watching and (
        event.startswith(FORBIDDEN)
        or (event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+"))
    ):
        _seen.append(f"{event} {arguments!r:.200}")


sys.addaudithook(_audit)


@contextmanager
def watched() -> Iterator[None]:
    """Fails if anything was run, written or connected to inside."""
    global _watching
    _seen.clear()
    _watching = True
    try:
        yield
    finally:
        _watching = False
    assert _seen == []


class Calls:
    """Pickles as a call of something."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def object_npy(thing, protocol=4) -> bytes:
    stream = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(stream, header)
    array = np.empty((), dtype=object)
    array[()] = thing
    stream.write(pickle.dumps(array, protocol))
    return stream.getvalue()


def zipped(**entries: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name.replace("__", "/").replace("_npy", ".npy"), data)
    return stream.getvalue()


def torch_bytes(thing, *, new: bool = True) -> bytes:
    stream = io.BytesIO()
    torch.save(thing, stream, _use_new_zipfile_serialization=new)
    return stream.getvalue()


def containers(thing, joblib_bytes) -> dict[str, bytes]:
    """The same thing in every container that can hold it."""
    return {
        "pickle": pickle.dumps(thing, 2),
        "zlib": zlib.compress(pickle.dumps(thing)),
        "gzip": gzip.compress(pickle.dumps(thing)),
        "joblib": joblib_bytes({"a": np.zeros(3), "b": thing}),
        "joblib, in objects": joblib_bytes({"a": np.array([thing, None], dtype=object)}),
        "npy": object_npy(thing),
        "npz": zipped(results_npy=object_npy({"deep": thing})),
        "torch": torch_bytes({"a": torch.zeros(3), "b": thing}),
        "torch, old": torch_bytes({"a": torch.zeros(3), "b": thing}, new=False),
        "tensor in an array": object_npy({"a": torch.zeros(3), "b": thing}),
    }


KINDS = tuple(containers(1, lambda thing: b""))
TORCH_KINDS = ("torch", "torch, old")


@pytest.mark.parametrize("kind", KINDS)
def test_code_in_any_container_is_refused_by_name_and_not_run(tmp_path, joblib_bytes, kind):
    marker = tmp_path / "ran"
    command = f"{sys.executable} -c \"open(r'{marker}', 'w')\""
    path = tmp_path / "poses.any"
    path.write_bytes(containers(Calls(os.system, command), joblib_bytes)[kind])
    with watched(), pytest.raises(InputError, match=r"asks to run (posix|nt)\.system"):
        read_poses(path)
    assert not marker.exists()


def test_the_watch_can_fail():
    with pytest.raises(AssertionError, match=r"os\.system"), watched():
        os.system("true")


def test_code_in_a_storage_of_a_tensor_is_refused(tmp_path):
    inner = pickle.dumps(Calls(os.system, "true"))
    path = tmp_path / "t.npy"
    path.write_bytes(object_npy({"t": Calls(torch.storage._load_from_bytes, inner)}))
    with watched(), pytest.raises(InputError):
        read_poses(path)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_harmless_is_read_from_any_container(tmp_path, joblib_bytes, kind):
    thing = {"n": np.arange(6.0).reshape(2, 3), "t": (1, 2.5, "x", None, True), 3: {"é": [b"b"]}}
    if kind in TORCH_KINDS:
        thing |= {"n": torch.from_numpy(thing["n"]), 3: {"é": ["b"]}}
    path = tmp_path / "any"
    path.write_bytes(containers(thing, joblib_bytes)[kind])
    found = read_untrusted_file(path)
    while isinstance(found, dict) and "n" not in found:
        found = found.get("b", found.get("deep", found.get("results", found.get("a"))))
        found = found[0] if isinstance(found, list) else found
    np.testing.assert_array_equal(found["n"], thing["n"])
    assert found["t"] == [1, 2.5, "x", None, True]
    assert found[3] == {"é": ["b"]}


def test_tensors_of_every_type_and_stride_are_read(tmp_path):
    base = torch.arange(24).reshape(2, 3, 4)
    tensors = [base.to(kind) for kind in (torch.float16, torch.float64, torch.int16, torch.uint8)]
    tensors += [base.float().transpose(0, 2), base.float()[:, 1:, ::2], base.bool()]
    tensors += [torch.ones(3).expand(5, 3), torch.zeros(0, 3), torch.nn.Parameter(base.float())]
    for data in (torch_bytes(tensors), torch_bytes(tensors, new=False), object_npy(tensors)):
        path = tmp_path / "t"
        path.write_bytes(data)
        for read, tensor in zip(read_untrusted_file(path), tensors, strict=True):
            np.testing.assert_array_equal(read, tensor.detach().numpy())


@pytest.mark.parametrize(
    "make",
    [
        lambda: zlib.compress(bytes(8 << 20), 9),
        lambda: gzip.compress(bytes(8 << 20), 9),
        lambda: zipped(a_npy=bytes(8 << 20)),
        lambda: bytes(3 << 20),
    ],
    ids=["zlib", "gzip", "zip", "large"],
)
def test_a_file_that_holds_too_much_is_refused(tmp_path, monkeypatch, make):
    path = tmp_path / "bomb"
    path.write_bytes(make())
    monkeypatch.setattr(file_content, "MAX_BYTES", 2 << 20)
    with pytest.raises(InputError, match="more than 2 MiB"):
        read_poses(path)


# --- random files ------------------------------------------------------------------------------


def seeds(joblib_bytes) -> list[bytes]:
    """Files of every container, small, from which random ones are made."""
    rows = {"pose": np.zeros((3, 72)), "trans": np.ones((3, 3)), "frame_ids": np.arange(3)}
    person = {"id": 0, "Rh": [[0, 0, 1]], "Th": [[0, 0, 3]], "poses": [[0] * 72]}
    thing = {0: rows, "person": person, "t": torch.ones(2, 3)}
    plain = {0: rows, "l": [1, 2.5, "x", None, (True,)], "s": {1, 2}}
    found = [joblib_bytes(plain), joblib_bytes(plain, compressed=True), object_npy(thing)]
    found += [pickle.dumps(plain, protocol) for protocol in range(6)]
    found += [torch_bytes(thing), torch_bytes(thing, new=False), json.dumps([person]).encode()]
    found += [zipped(results_npy=object_npy({"smpl_thetas": np.zeros((1, 72))}))]
    return found


def random_files(count: int, joblib_bytes) -> Iterator[bytes]:
    rng = np.random.default_rng(count)
    whole = seeds(joblib_bytes)
    for number in range(count):
        if number % 8 == 7:
            yield random_opcodes(rng)
        else:
            yield mutate_bytes(whole[number % len(whole)], whole, rng)


def outcome(path: Path, read) -> str:
    """How reading one file ended: read, or refused with a message that names it."""
    try:
        read(path)
    except InputError as refusal:
        return "refused" if str(path) in str(refusal) else "refused without its name"
    return "read"


def test_random_files_are_read_or_refused_and_no_worse(tmp_path, joblib_bytes):
    ended = Counter()
    path = tmp_path / "random.pkl"
    for data in random_files(FILES, joblib_bytes):
        path.write_bytes(data)
        with watched():
            ended[outcome(path, read_untrusted_file)] += 1
            outcome(path, read_poses)
            with suppress(InputError):
                load_body_model(path)
    assert sum(ended.values()) == FILES
    assert min(ended["read"], ended["refused"]) > FILES // 20  # neither whole files nor noise
    assert set(ended) == {"read", "refused"}, ended
