"""HDF5 files: what would make their library hang is refused before it reads it; arrays that all cores compress."""

import struct

import h5py
import numpy as np
import pytest

from spadwarp.io import hdf5
from spadwarp.io.hdf5 import hdf5_format, read_hdf5, write_hdf5
from spadwarp.values import FileError


@pytest.fixture
def path(tmp_path):
    with write_hdf5(tmp_path / "file.h5") as file:
        file.attrs["format"] = "a format"
        file["text"] = "a text " * 1000
        file["numbers"] = np.arange(10_000)
    return tmp_path / "file.h5"


def collections(content):
    """Where texts of any length lie."""
    place = content.find(b"GCOL")
    while place >= 0:
        yield place
        place = content.find(b"GCOL", place + 1)


@pytest.mark.parametrize(
    ("form", "offset", "values"),
    [
        *(("<Q", 24, (size,)) for size in (2**64 - 16, 2**64 - 1, 2**63, 1 << 20, 4096)),  # of the first object
        ("<HxxxxxxQ", 16, (0, 0)),  # free space of no size
        ("<Q", 8, (2**40,)),
    ],
)
def test_texts_whose_sizes_do_not_fit_are_refused(path, form, offset, values):
    """HDF5 follows such sizes for ever. A file that has been read is looked at again."""
    assert hdf5_format(path) == "a format"
    content = path.read_bytes()
    for place in collections(content):
        changed = bytearray(content)
        struct.pack_into(form, changed, place + offset, *values)
        path.write_bytes(changed + b"\0")
        with pytest.raises(FileError, match=r"file\.h5: damaged: the file has damaged text"):
            hdf5_format(path)


def test_letters_that_only_look_like_a_text_do_no_harm(tmp_path):
    numbers = np.frombuffer(b"GCOL\0\0\0\0" * 100 + b"\x89HDF\r\n\x1a\n", np.int64)
    with write_hdf5(tmp_path / "file.h5") as file:
        file["numbers"] = numbers
        file.attrs["format"] = "a format"
    with read_hdf5(tmp_path / "file.h5", "a format") as file:
        np.testing.assert_array_equal(file.array("numbers", np.int64, (None,)), numbers)


def test_attributes_are_text_or_numbers(path):
    ragged = np.empty(1, object)
    ragged[0] = np.arange(3, dtype=np.int32)
    with h5py.File(path, "r+") as file:
        file.attrs.create("list", ragged, dtype=h5py.vlen_dtype(np.int32))
        file.attrs.create("place", file["text"].ref, dtype=h5py.ref_dtype)
        file.attrs.create("pair", np.zeros((), "i4,f4"))
        file.attrs["many"] = np.zeros(8000)
        file.attrs["flag"] = True
    with read_hdf5(path) as file:
        assert file.flag("flag") and file.attribute("many").shape == (8000,)
        for name in ("list", "place", "pair"):
            with pytest.raises(FileError, match=f"{name} is neither text nor numbers"):
                file.attribute(name)


RNG = np.random.default_rng(3)
FILTERS = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


@pytest.mark.parametrize(
    ("values", "chunks"),
    [
        (RNG.poisson(2.0, (3, 7, 9, 50)).astype(np.int64) << 20, (1, 4, 5, 50)),  # chunks over the edge
        (RNG.integers(0, 2**63, (2, 30, 20), dtype=np.uint64), (1, 15, 20)),  # not to be compressed
        (np.zeros((2, 8, 8), np.float32), (1, 8, 8)),
    ],
)
@pytest.mark.parametrize("least", [0, 1 << 30])
def test_packed_arrays_come_back_with_the_filters_of_hdf5(tmp_path, monkeypatch, values, chunks, least):
    monkeypatch.setattr(hdf5, "_LARGE", least)
    with h5py.File(tmp_path / "own.h5", "w") as file:
        hdf5.write_packed(file, "x", values, chunks=chunks, compression=1)
    with h5py.File(tmp_path / "own.h5") as own:
        assert np.array_equal(own["x"][...], values)
        assert own["x"].dtype == values.dtype and own["x"].chunks == chunks
        assert {name: getattr(own["x"], name) for name in FILTERS} == FILTERS


def test_a_damaged_chunk_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "_LARGE", 0)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        made = hdf5.write_packed(file, "x", np.arange(6000), chunks=(1000,), compression=1)
        place = made.id.get_chunk_info(3).byte_offset
    data = bytearray((tmp_path / "x.h5").read_bytes())
    data[place + 10] ^= 1
    (tmp_path / "x.h5").write_bytes(data)
    with h5py.File(tmp_path / "x.h5") as file, pytest.raises(OSError, match=r"filter|[Cc]hecksum"):
        file["x"][...]
