"""Archives of arrays, and of other things."""

import zipfile

import numpy as np
import pytest

from capture.input_error import InputError
from preprocess import file_content
from preprocess.file_content import read_npz


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
