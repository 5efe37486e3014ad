"""MATLAB files: the arrays that SciPy writes are read as they are, and damaged ones are refused."""

import numpy as np
import pytest
from scipy import sparse
from scipy.io import savemat

from spadwarp.io.mat import open_mat
from spadwarp.values import FileError

KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?")


def read(path, name):
    with open_mat(path) as variables:
        return variables[name].read()


def shapes_of(path):
    with open_mat(path) as variables:
        return {name: variable.shape for name, variable in variables.items() if variable.kind == "dense"}


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_are_those_that_scipy_writes(tmp_path, packed):
    generator = np.random.default_rng(1)
    arrays = {f"a{number}": (100 * generator.random((3, 4, 5))).astype(kind) for number, kind in enumerate(KINDS)}
    arrays |= {"one": np.array([[7.0]]), "zeros": np.zeros((200, 300)), "flat": np.arange(6.0)}
    others = {"text": "letters", "cell": np.array([1, "x"], object), "complex": np.ones((2, 2)) * 1j}
    savemat(tmp_path / "file.mat", arrays | others, do_compression=packed)
    for name, values in arrays.items():
        np.testing.assert_array_equal(read(tmp_path / "file.mat", name), np.atleast_2d(values))
    assert shapes_of(tmp_path / "file.mat") == {name: np.atleast_2d(values).shape for name, values in arrays.items()}


@pytest.mark.parametrize("packed", [False, True])
def test_sparse_matrices_and_cells_are_those_that_scipy_writes(tmp_path, packed):
    matrix = sparse.random_array((30, 20), density=0.1, random_state=2, format="csc")
    cells = np.empty((2, 3), object)
    for index in range(6):
        cells.flat[index] = np.arange(float(index))
    variables = {"matrix": matrix, "cells": cells, "empty": sparse.csc_array((4, 5))}
    variables["mixed"] = np.array([1, "x"], object)
    savemat(tmp_path / "file.mat", variables, do_compression=packed)
    for name in ("matrix", "empty"):
        found = read(tmp_path / "file.mat", name)
        again = sparse.coo_array((found.value, (found.row, found.column)), found.shape)
        np.testing.assert_array_equal(again.toarray(), variables[name].toarray())
    for one, two in zip(read(tmp_path / "file.mat", "cells").flat, cells.flat, strict=True):
        np.testing.assert_array_equal(one, two)
    with pytest.raises(FileError, match="cell 1 holds no array of numbers"):
        read(tmp_path / "file.mat", "mixed")


def test_files_of_version_7_3_hold_nothing_of_other_files(tmp_path):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "secret").write_bytes(b"secret" * 100)
    with h5py.File(tmp_path / "file.mat", "w") as file:
        file["a"] = np.arange(60.0).reshape(5, 4, 3)
        file.create_dataset("stolen", (3, 4), np.uint8, external=[(str(tmp_path / "secret"), 0, 12)])
        file.create_dataset("bomb", (1 << 40, 8, 8), np.uint8, chunks=(1, 8, 8))
    np.testing.assert_array_equal(read(tmp_path / "file.mat", "a"), np.arange(60.0).reshape(5, 4, 3).T)
    for name in ("stolen", "bomb"):
        with pytest.raises(FileError, match=f"file.mat: .*{name}"):
            read(tmp_path / "file.mat", name)


KIND = (12).to_bytes(4, "little"), (480).to_bytes(4, "little")  # the tag of 60 int64
SHAPE = np.array([3, 4, 5], "<i4").tobytes()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # SciPy looks it up beyond the end of a table, and the process ends.
        *((b"".join(KIND), kind.to_bytes(4, "little"), "damaged or not read") for kind in (0, 8, 14, 255, 65535)),
        (SHAPE, np.array([2**30] * 3, "<i4").tobytes(), "is not in"),
    ],
)
def test_types_that_do_not_exist_and_bombs_are_refused(tmp_path, old, new, words):
    savemat(tmp_path / "file.mat", {"a": np.arange(60).reshape(3, 4, 5)})
    content = bytearray((tmp_path / "file.mat").read_bytes())
    place = content.index(old)
    content[place : place + len(new)] = new
    (tmp_path / "file.mat").write_bytes(content)
    with pytest.raises(FileError, match=rf"file\.mat: .*{words}"):
        read(tmp_path / "file.mat", "a")
