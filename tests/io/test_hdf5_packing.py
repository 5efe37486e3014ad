"""Arrays that all cores compress, as HDF5 reads them; it compares the checksum of every chunk."""

import h5py
import numpy as np
import pytest

from spadwarp.io import hdf5

RNG = np.random.default_rng(3)
FILTERS = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


@pytest.mark.parametrize(
    ("values", "chunks"),
    [
        (RNG.poisson(2.0, (3, 7, 9, 50)).astype(np.int64) << 20, (1, 4, 5, 50)),  # chunks over the edge
        (RNG.integers(0, 2**63, (2, 30, 20), dtype=np.uint64), (1, 15, 20)),  # not to be compressed
        (np.zeros((2, 8, 8), np.float32), (1, 8, 8)),
    ],
)
@pytest.mark.parametrize("least", [0, 1 << 30])
def test_arrays_come_back_from_files_as_hdf5_makes_them(tmp_path, monkeypatch, values, chunks, least):
    monkeypatch.setattr(hdf5, "_LARGE", least)
    with h5py.File(tmp_path / "own.h5", "w") as file:
        hdf5.write_packed(file, "x", values, chunks=chunks, compression=1)
    with h5py.File(tmp_path / "hdf5.h5", "w") as file:
        file.create_dataset("x", data=values, chunks=chunks, **FILTERS)
    with h5py.File(tmp_path / "own.h5") as own, h5py.File(tmp_path / "hdf5.h5") as other:
        assert np.array_equal(own["x"][...], values)
        assert own["x"].dtype == values.dtype and own["x"].chunks == chunks
        assert {name: getattr(own["x"], name) for name in FILTERS} == FILTERS
        offset = (0,) * values.ndim
        checksums = [file["x"].id.read_direct_chunk(offset)[1][-4:] for file in (own, other)]
        assert checksums[0] == checksums[1]


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
