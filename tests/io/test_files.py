"""Files: HDF5 loses nothing, EXR stores what it was given, and nothing half-written is ever seen."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import h5py
import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.synthetic_result import make_result, make_scene
from spadwarp.errors import FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.io.exr import read_exr, write_exr
from spadwarp.io.hdf5 import write_hdf5
from spadwarp.result.file import load_result, load_truth_maps, save_depth_exr, save_result, save_truth_maps
from spadwarp.result.result import Result


@pytest.fixture(scope="module")
def result() -> Result:
    return make_result(make_scene())


def assert_same(a: Result, b: Result) -> None:
    for field in dataclasses.fields(Result):
        if field.name not in ("tallies", "truth"):
            assert getattr(a, field.name) == getattr(b, field.name), field.name
    np.testing.assert_array_equal(a.tallies, b.tallies, strict=True)
    for name in ("depth", "range", "normal", "reflectance"):
        one, other = getattr(a.truth, name), getattr(b.truth, name)
        assert one.tobytes() == other.tobytes()  # NaNs included
        assert one.dtype == other.dtype


# HDF5


def test_hdf5_loses_nothing(result: Result, tmp_path: Path) -> None:
    path = result.save(tmp_path / "result.h5")
    again = load_result(path)
    assert_same(result, again)
    np.testing.assert_array_equal(again.histogram, result.histogram)
    again.save(tmp_path / "again.h5")
    assert_same(result, load_result(tmp_path / "again.h5"))


def test_hdf5_keeps_the_largest_numbers(result: Result, tmp_path: Path) -> None:
    tallies = result.tallies.copy()
    tallies[0, 0, 0, :2] = 2**63 - 1, -(2**63)
    start = 2**64 - 1 - result.photons
    extreme = dataclasses.replace(
        result,
        tallies=tallies,
        seed=2**64 - 1,
        photon_ranges=((start, start + result.photons),),
        ledger={"absorbed_water": 10**30, "roulette": -(10**30)},
        counters={"water_collisions": 2**80},
        provenance={"text": "µ, 水", "nested": {"list": [1, 2.5, None, True]}},
        partial=True,
    )
    assert_same(extreme, load_result(extreme.save(tmp_path / "extreme.h5")))


def test_hdf5_remembers_the_scene_file(tmp_path: Path) -> None:
    scene = make_scene()
    scene = type(scene).from_dict(scene.to_dict(), source=tmp_path / "scene.toml")
    again = load_result(make_result(scene).save(tmp_path / "result.h5")).scene
    assert again == scene
    assert again.source == scene.source


def test_hdf5_can_be_read_alone(result: Result, tmp_path: Path) -> None:
    # With nothing but h5py, the file and its own explanation.
    with h5py.File(result.save(tmp_path / "result.h5")) as file:
        attributes = dict(file.attrs)
        fraction = file["tallies"][...].sum(axis=0) * (attributes["unit"] / attributes["photons"])
        time = attributes["gate_start"] + attributes["bin_width"] * np.arange(file["tallies"].shape[-1] + 1)
        path = time * 299792458 / attributes["group_index"]
        detections = fraction * attributes["laser_photons_per_pulse"] * attributes["detector_pde"]
        assert file["tallies"].compression == "gzip"
        assert isinstance(attributes["seed"], str)
    np.testing.assert_array_equal(fraction, result.histogram)
    np.testing.assert_allclose(path, result.path_edges, rtol=1e-14)
    np.testing.assert_allclose(detections, result.detections, rtol=1e-14)


def test_hdf5_is_the_same_bytes_each_time(result: Result, tmp_path: Path) -> None:
    one, two = result.save(tmp_path / "1.h5"), result.save(tmp_path / "2.h5")
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize("level", [0, 10])
def test_compression_levels_are_those_of_gzip(result: Result, tmp_path: Path, level: int) -> None:
    with pytest.raises(ValueError, match=rf"compression = {level} is outside \[1, 9\]"):
        save_result(result, tmp_path / "result.h5", compression=level)


# Files that are not whole


def test_failed_writes_leave_the_old_file_and_no_other(
    result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = result.save(tmp_path / "result.h5")
    before = path.read_bytes()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        dataclasses.replace(result, seed=8).save(path)
    assert [one.name for one in tmp_path.iterdir()] == ["result.h5"]
    assert path.read_bytes() == before


def test_a_write_that_fails_midway_says_where_and_cleans_up(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.bin"
    with pytest.raises(FileError, match=r"file\.bin: cannot be written: disk full"), atomic_path(path) as temporary:
        assert temporary.parent == path.parent  # a rename across file systems would not be atomic
        temporary.write_bytes(b"half")
        raise OSError("disk full")
    assert list(path.parent.iterdir()) == []


def test_hdf5_does_not_wait_in_memory(tmp_path: Path) -> None:
    with write_hdf5(tmp_path / "large.h5") as file:
        file["zeros"] = np.zeros(1 << 20)
        file.flush()
        assert sum(one.stat().st_size for one in tmp_path.iterdir()) > 8 << 20
    assert [one.name for one in tmp_path.iterdir()] == ["large.h5"]


def test_folders_that_cannot_be_made_are_named(result: Result, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    for save in (lambda path: result.save(path), lambda path: write_exr(path, {"Z": np.ones((2, 2))})):
        with pytest.raises(FileError, match="cannot be written"):
            save(tmp_path / "file" / "result")


def test_missing_foreign_and_newer_files_are_told_apart(result: Result, tmp_path: Path) -> None:
    def error_of(path: Path) -> str:
        with pytest.raises(FileError) as caught:
            load_result(path)
        text = str(caught.value)
        assert text.startswith(f"{path}: ")
        return text

    assert "no such file" in error_of(tmp_path / "none.h5")
    assert "is not a file" in error_of(tmp_path)
    (tmp_path / "text.h5").write_text("not HDF5")
    assert "not an HDF5 file" in error_of(tmp_path / "text.h5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = np.arange(3)
    assert "not a spadwarp result" in error_of(tmp_path / "foreign.h5")
    with h5py.File(tmp_path / "foreign.h5", "r+") as file:
        file.attrs["format"] = "spadwarp frames"
    assert "its format is 'spadwarp frames'" in error_of(tmp_path / "foreign.h5")
    newer = result.save(tmp_path / "newer.h5")
    with h5py.File(newer, "r+") as file:
        file.attrs["format_version"] = 99
    assert "format version 99 is newer" in error_of(newer)


@pytest.mark.parametrize("name", ["tallies", "config", "ledger", "truth/normal", "photon_ranges"])
def test_results_with_parts_missing_are_refused(result: Result, tmp_path: Path, name: str) -> None:
    path = result.save(tmp_path / "result.h5")
    with h5py.File(path, "r+") as file:
        del file[name]
    with pytest.raises(FileError, match=r"result\.h5: not a whole spadwarp result: .*" + name.split("/")[-1]):
        load_result(path)


@pytest.mark.parametrize("name", ["unit", "photons", "seed", "format_version"])
def test_results_with_attributes_missing_are_refused(result: Result, tmp_path: Path, name: str) -> None:
    path = result.save(tmp_path / "result.h5")
    with h5py.File(path, "r+") as file:
        del file.attrs[name]
    with pytest.raises(FileError, match=r"result\.h5: not a whole spadwarp result: .*" + name):
        load_result(path)


def test_truncated_files_are_refused(result: Result, tmp_path: Path) -> None:
    path = result.save(tmp_path / "result.h5")
    content = path.read_bytes()
    for length in (0, 8, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FileError, match=r"result\.h5: "):
            load_result(path)


def test_flipped_bits_in_the_tallies_are_noticed(result: Result, tmp_path: Path) -> None:
    path = result.save(tmp_path / "result.h5")
    with h5py.File(path) as file:
        chunk = file["tallies"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileError, match="damaged"):
        load_result(path)


# EXR


@given(
    pixels=arrays.arrays(
        dtype=st.sampled_from([np.float16, np.float32, np.uint32]), shape=arrays.array_shapes(min_dims=2, max_dims=2)
    )
)
def test_exr_gives_back_what_it_was_given(tmp_path_factory: pytest.TempPathFactory, pixels: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("exr") / "image.exr"
    write_exr(path, {"Z": pixels, "N.X": pixels[::-1, ::-1]})
    channels, _ = read_exr(path)
    assert channels.keys() == {"Z", "N.X"}
    np.testing.assert_array_equal(channels["Z"], pixels, strict=True)
    np.testing.assert_array_equal(channels["N.X"], pixels[::-1, ::-1], strict=True)


def test_exr_stores_arrays_that_are_not_contiguous(tmp_path: Path) -> None:
    # Views of one array with every kind of stride: transposed, strided, reversed, one channel of an image, broadcast.
    cube = np.random.default_rng(1).normal(size=(8, 10, 3)).astype(np.float32)
    views = {
        "transposed": cube[:, :8, 0].T,
        "strided": np.repeat(cube[:, :8, 0], 2, axis=1)[:, ::2],
        "reversed": cube[::-1, 7::-1, 1],
        "channel": cube[:, 1:9, 2],
        "fortran": np.asfortranarray(cube[:, :8, 1]),
        "broadcast": np.broadcast_to(cube[0, :8, 0], (8, 8)),
    }
    write_exr(tmp_path / "views.exr", views)
    channels, _ = read_exr(tmp_path / "views.exr")
    for name, view in views.items():
        np.testing.assert_array_equal(channels[name], view, err_msg=name)


def test_exr_leaves_the_callers_dictionaries_alone(tmp_path: Path) -> None:
    pixels = np.ones((2, 3), dtype=np.float32)
    channels, metadata = {"Z": pixels}, {"note": "text"}
    write_exr(tmp_path / "image.exr", channels, metadata)
    assert channels == {"Z": pixels}
    assert metadata == {"note": "text"}


def test_exr_metadata_are_not_truncated(tmp_path: Path) -> None:
    metadata = {"seed": 2**64 - 1, "unit": 0.1, "config": "[medium]\nextinction = 0.3\n", "empty": "", "text": "µ 水"}
    write_exr(tmp_path / "image.exr", {"Z": np.ones((2, 3))}, metadata)
    _, read = read_exr(tmp_path / "image.exr")
    assert read == {name: str(value) for name, value in metadata.items()}


@pytest.mark.parametrize(
    ("channels", "metadata", "message"),
    [
        ({}, {}, "at least one channel"),
        ({"Z": np.ones((2, 3)), "R": np.ones((3, 2))}, {}, "one shape for all"),
        ({"Z": np.ones((2, 3, 1))}, {}, r"'Z' has shape \(2, 3, 1\)"),
        ({"Z": np.ones((0, 3))}, {}, r"'Z' has shape \(0, 3\)"),
        ({"Z": np.ones((2, 3), dtype=np.int64)}, {}, "'Z' is int64"),
        ({"Z": np.ones((2, 3), dtype=complex)}, {}, "'Z' is complex128"),
        ({"Z": np.ones((2, 3))}, {"dataWindow": "mine"}, "'dataWindow' is one that EXR uses itself"),
    ],
)
def test_exr_refuses_what_it_cannot_hold(tmp_path: Path, channels: dict, metadata: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "image.exr", channels, metadata)
    assert list(tmp_path.iterdir()) == []


def test_exr_files_that_are_not_whole_are_refused(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "image.exr", {"Z": np.random.default_rng(0).normal(size=(40, 50))})
    content = path.read_bytes()
    for length in (0, 3, 100, len(content) // 2, len(content) - 5):
        path.write_bytes(content[:length])
        with pytest.raises(FileError, match=r"image\.exr: not an EXR image, or damaged"):
            read_exr(path)
    with pytest.raises(FileError, match="no such file"):
        read_exr(tmp_path / "none.exr")
    with pytest.raises(FileError, match="is not a file"):
        read_exr(tmp_path)


def test_truth_survives_exr(result: Result, tmp_path: Path) -> None:
    path = save_truth_maps(result, tmp_path / "truth.exr")
    again = load_truth_maps(path)
    for name in ("depth", "range", "normal", "reflectance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result.truth, name), strict=True)
    # The names that other programs look for, in 32-bit floats.
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert set(file.channels()) == {"Z", "range", "N.X", "N.Y", "N.Z", "R", "G", "B"}
        assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(np.float32)}
        assert file.header()["Z"] == "planar depth [m]"
        assert file.header()["seed"] == "7"


def test_depth_survives_exr(result: Result, tmp_path: Path) -> None:
    depth = result.truth.depth.astype(np.float64) + 0.01
    channels, metadata = read_exr(save_depth_exr(result, depth, tmp_path / "depth.exr"))
    np.testing.assert_array_equal(channels["Z"], depth.astype(np.float32), strict=True)
    assert metadata["content"] == "measured depth"
    with pytest.raises(FileError, match=r"not truth maps: no channel range, N\.X"):
        load_truth_maps(tmp_path / "depth.exr")


@pytest.mark.skipif("SPADWARP_EXTRA_DATA" not in os.environ, reason="SPADWARP_EXTRA_DATA names no folder with ue_exr")
@pytest.mark.parametrize("name", ["babiao", "cat"])
def test_a_game_engines_exports_are_read(name: str) -> None:
    folder = Path(os.environ["SPADWARP_EXTRA_DATA"]) / "ue_exr"
    for kind in ("RGBD", "Base_Col", "Surf_Norm"):
        channels, _ = read_exr(folder / f"{name}_{kind}.EXR")
        assert set(channels) == {"R", "G", "B", "A"}
        assert all(pixels.shape == (192, 256) and pixels.dtype == np.float16 for pixels in channels.values())
    depth = read_exr(folder / f"{name}_RGBD.EXR")[0]["A"].astype(float)  # centimetres
    if name == "babiao":  # the staircase: plate at 14.89 m, bars 0.1 to 0.6 m proud
        assert {1429.0, 1439.0, 1449.0, 1459.0, 1469.0, 1479.0, 1489.0} <= set(np.unique(depth))
