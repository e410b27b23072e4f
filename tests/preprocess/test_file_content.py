"""Archives of arrays, and pickles of others, of which nothing runs."""

import io
import pickle
import pickletools
import struct
import sys
import types
import zipfile
from typing import ClassVar

import numpy as np
import pytest
from scipy import sparse

from capture.input_error import InputError
from preprocess import file_content
from preprocess.body.parametric_body import load_body_model
from preprocess.file_content import read_npz, read_pickled_arrays


def test_all_keys_or_those_that_are_wanted_and_there(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(3), b=np.eye(2), c=np.array([{}]))
    read = read_npz(path, ("a", "b", "missing"))
    np.testing.assert_array_equal(read["a"], [0, 1, 2])
    np.testing.assert_array_equal(read["b"], np.eye(2))
    assert set(read) == {"a", "b"}
    with pytest.raises(InputError, match="pickled objects"):
        read_npz(path)


def test_every_cut_and_a_flipped_byte_of_an_archive_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.random.default_rng(0).random(200))
    whole = path.read_bytes()
    half = len(whole) // 2
    damaged = [whole[:kept] for kept in range(0, len(whole), 37)]
    for data in (*damaged, whole[:half] + bytes([whole[half] ^ 0xFF]) + whole[half + 1 :]):
        path.write_bytes(data)
        with pytest.raises(InputError, match="Is the file complete"):
            read_npz(path)


def test_a_zip_of_something_else_has_no_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert read_npz(tmp_path / "a.npz") == {}


def test_an_archive_that_unpacks_to_too_much_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(10000))
    monkeypatch.setattr(file_content, "MAX_BYTES", 1 << 12)
    with pytest.raises(InputError, match="unpacks to more than"):
        read_npz(path)


class Python2Pickler(pickle._Pickler):
    """Writes texts and bytes as Python 2's strings, and its names of modules."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_string(self, text):
        data = text.encode("latin1") if isinstance(text, str) else text
        self.write(b"T" + struct.pack("<i", len(data)) + data)
        self.memoize(text)

    dispatch[str] = save_string
    dispatch[bytes] = save_string


def python2_pickle(thing) -> bytes:
    stream = io.BytesIO()
    Python2Pickler(stream, 2, fix_imports=True).dump(thing)
    data = stream.getvalue().replace(b"numpy._core.", b"numpy.core.")
    return data.replace(b"scipy.sparse._csc", b"scipy.sparse.csc")


@pytest.fixture
def chumpy(monkeypatch):
    """Classes that pickle under chumpy's names (which need not be installed, and is not read)."""
    ch, reordering = types.ModuleType("chumpy.ch"), types.ModuleType("chumpy.reordering")
    for module, name in ((ch, "Ch"), (reordering, "Select"), (reordering, "transpose")):
        kind = type(name, (), {"__module__": module.__name__})
        kind.__init__ = lambda self, **state: self.__dict__.update(state)
        setattr(module, name, kind)
    for name, module in (("chumpy", ch), ("chumpy.ch", ch), ("chumpy.reordering", reordering)):
        monkeypatch.setitem(sys.modules, name, module)
    return types.SimpleNamespace(Ch=ch.Ch, Select=reordering.Select, Transpose=reordering.transpose)


def test_a_python_2_file_with_chumpy_and_scipy_is_read(tmp_path, smpl_arrays, chumpy):
    content = dict(smpl_arrays)
    content["J_regressor"] = sparse.csc_matrix(smpl_arrays["J_regressor"])
    content["shapedirs"] = chumpy.Ch(x=smpl_arrays["shapedirs"], _dirty_vars=set())
    wide = np.asfortranarray(np.concatenate([smpl_arrays["posedirs"]] * 2, axis=2))
    chosen = np.arange(wide.size).reshape(wide.shape)[..., 207:].ravel()
    content["posedirs"] = chumpy.Select(
        a=chumpy.Ch(x=wide), idxs=chosen, preferred_shape=smpl_arrays["posedirs"].shape
    )
    content["v_template"] = chumpy.Transpose(a=chumpy.Ch(x=smpl_arrays["v_template"].T), axes=None)
    content["bs_style"] = "lbs"
    path = tmp_path / "body.pkl"
    path.write_bytes(python2_pickle(content))
    names = {arg for op, arg, _ in pickletools.genops(path.read_bytes()) if op.name == "GLOBAL"}
    assert {"chumpy.ch Ch", "numpy.core.multiarray _reconstruct"} <= names
    body = load_body_model(path)
    np.testing.assert_array_equal(body.template, smpl_arrays["v_template"])
    np.testing.assert_array_equal(body.shape_directions, smpl_arrays["shapedirs"])
    np.testing.assert_array_equal(body.pose_directions, smpl_arrays["posedirs"])
    np.testing.assert_allclose(
        body.joints, smpl_arrays["J_regressor"] @ smpl_arrays["v_template"], atol=1e-12
    )
    assert body.parents[0] == -1


@pytest.mark.parametrize("kind", ["<f8", ">f4", "<i2", "|u1", "|b1", ">u8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_go_round_in_every_type_order_and_protocol(tmp_path, kind, order):
    array = np.asarray(np.arange(24).reshape(2, 3, 4) % 7, dtype=kind, order=order)
    path, held = tmp_path / "a.pkl", {"a": array, "s": array[0, 0, 1], "l": [1.5, 2]}
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps(held, protocol))
        read = read_pickled_arrays(path, (*held, "missing"))
        assert read.keys() == held.keys()
        for key, value in held.items():
            np.testing.assert_array_equal(read[key], value)


def test_names_are_allowed_exactly_not_by_module(tmp_path):
    path = tmp_path / "a.pkl"
    for name in (b"numpy\nload", b"numpy.core.multiarray\nfromfile", b"builtins\nsetattr"):
        path.write_bytes(b"c" + name + b"\n.")
        with pytest.raises(InputError, match="nothing was run"):
            read_pickled_arrays(path, ("a",))


@pytest.mark.parametrize(
    "data",
    [
        b"]" * 10_000,  # no end
        b"cbuiltins\nset\n}}\x86b.",  # a state for a class
        b"cchumpy.ch\nCh\n}}\x86b.",  # a state for one of ours
        b"\x80\x04\x82\x01.",  # copyreg's extensions
        b"P7\n.",  # an object outside the file
        b"I1\n.",  # no dictionary
        b"\x80\x05\x95" + struct.pack("<Q", 1 << 40) + b"I1\n.",  # a frame of a terabyte
    ],
)
def test_rubbish_is_refused(tmp_path, data):
    path = tmp_path / "a.pkl"
    path.write_bytes(data)
    with pytest.raises(InputError):
        read_pickled_arrays(path, ("a",))


def test_what_is_no_array_is_refused_by_its_key(tmp_path, chumpy):
    loop = chumpy.Ch()
    loop.x = loop
    huge = sparse.csc_matrix((3, 3))
    huge._shape = (1 << 20, 1 << 20)
    far = chumpy.Select(a=np.zeros(3), idxs=np.array([10**9]))
    path = tmp_path / "a.pkl"
    for thing in (loop, huge, far, chumpy.Ch(), {"a": 1}, "text", None, [[1], [2, 3]]):
        path.write_bytes(python2_pickle({"a": thing}))
        with pytest.raises(InputError, match="`a`"):
            read_pickled_arrays(path, ("a",))
