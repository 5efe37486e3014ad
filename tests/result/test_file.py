"""Files of a result: HDF5 loses nothing and refuses what is not whole; truth maps and depth as EXR."""

import dataclasses
import gc
import os
from unittest import mock

import h5py
import numpy as np
import OpenEXR
import pytest
import trimesh

import spadwarp
from helpers.datasets import make, recipe
from helpers.scenes import scene
from helpers.synthetic_result import make_result, make_scene
from spadwarp.io.arrays import read_exr
from spadwarp.result import Result, load_result, load_truth_maps, merge, save_depth_exr, save_result, save_truth_maps
from spadwarp.values import ConfigError, FileError

TRUTH = ("depth", "range", "normal", "reflectance")


@pytest.fixture(scope="module")
def result():
    return make_result(make_scene())


def assert_same(a, b):
    for field in dataclasses.fields(Result):
        if field.name not in ("tallies", "truth"):
            assert getattr(a, field.name) == getattr(b, field.name), field.name
    np.testing.assert_array_equal(a.tallies, b.tallies, strict=True)
    for name in TRUTH:
        one, other = getattr(a.truth, name), getattr(b.truth, name)
        assert one.tobytes() == other.tobytes()  # NaNs included
        assert one.dtype == other.dtype


def test_hdf5_loses_nothing(result, tmp_path):
    scene = type(result.scene).from_dict(result.scene.to_dict(), source=tmp_path / "scene.toml")
    result = dataclasses.replace(result, scene=scene)
    again = load_result(result.save(tmp_path / "result.h5"))
    assert_same(result, again)
    assert again.scene.source == scene.source
    np.testing.assert_array_equal(again.histogram, result.histogram)
    # The same bytes each time.
    assert again.save(tmp_path / "again.h5").read_bytes() == (tmp_path / "result.h5").read_bytes()


def test_hdf5_keeps_the_largest_numbers(result, tmp_path):
    tallies = result.tallies.copy()
    tallies[0, 0, 0, 0] = 2**63 - 1
    ids = (2**64 - 1 - result.photons, 2**64 - 1)
    extreme = dataclasses.replace(
        result,
        tallies=tallies,
        seed=2**64 - 1,
        photon_ranges=(ids,),
        requested=ids,
        energy_balance={"absorbed_water": 10**30, "roulette": -(10**30)},
        counters={"water_collisions": 2**80},
        provenance={"text": "µ, 水", "nested": {"list": [1, 2.5, None, True]}},
        partial=True,
    )
    assert_same(extreme, load_result(extreme.save(tmp_path / "extreme.h5")))


def test_hdf5_can_be_read_alone(result, tmp_path):
    """With nothing but h5py, the file and its own explanation."""
    with h5py.File(result.save(tmp_path / "result.h5")) as file:
        tallies, facts = file["tallies"][...], dict(file.attrs)
        assert file["tallies"].compression == "gzip" and isinstance(facts["seed"], str)
    fraction = tallies.sum(axis=0) * (facts["unit"] / facts["photons"])
    path = (facts["gate_start"] + facts["bin_width"] * np.arange(tallies.shape[-1] + 1)) * 299792458
    detections = fraction * facts["laser_photons_per_pulse"] * facts["detector_pde"]
    np.testing.assert_array_equal(fraction, result.histogram)
    np.testing.assert_allclose(path / facts["group_index"], result.path_edges, rtol=1e-14)
    np.testing.assert_allclose(detections, result.detections, rtol=1e-14)


def test_compression_levels_are_those_of_gzip(result, tmp_path):
    for level in (0, 10):
        with pytest.raises(ValueError, match=rf"compression = {level} is outside \[1, 9\]"):
            save_result(result, tmp_path / "result.h5", compression=level)


# Files that are not whole


def test_failed_writes_leave_the_old_file_and_no_other(result, tmp_path, monkeypatch):
    path = result.save(tmp_path / "result.h5")
    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", mock.Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        dataclasses.replace(result, seed=8).save(path)
    assert [one.name for one in tmp_path.iterdir()] == ["result.h5"]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.h5", None, "no such file"),
        ("", None, "is not a file"),
        ("text.h5", "not HDF5", "not an HDF5 file"),
        ("planned.toml", "[medium]", "`spadwarp simulate"),
        ("planed.toml", None, "did you mean 'planned.toml'?"),
        ("foreign.h5", {}, "not a spadwarp result"),
        ("foreign.h5", {}, "the directory of a run"),
        ("foreign.h5", {"format": "spadwarp frames"}, "its format is 'spadwarp frames'"),
        ("newer.h5", {"format": "spadwarp result", "format_version": 99}, "format version 99 is newer"),
    ],
)
def test_missing_foreign_and_newer_files_are_told_apart(tmp_path, name, content, words):
    (tmp_path / "planned.toml").touch()
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content)
    elif content is not None:
        with h5py.File(path, "w") as file:
            file.attrs.update(content)
    with pytest.raises(FileError) as caught:
        load_result(path)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)


def test_flipped_bits_in_the_tallies_are_noticed(result, tmp_path):
    path = result.save(tmp_path / "result.h5")
    with h5py.File(path) as file:
        chunk = file["tallies"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileError, match="damaged"):
        load_result(path)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *((name, None, f".*{name}") for name in ("unit", "photons", "seed", "format_version")),
        ("tallies", -1, "tallies are negative"),
        ("truth/depth", np.inf, "truth/depth is infinite"),
        ("photon_ranges", 0, "photon_ranges are not ranges"),
        ("requested", 5, "requested from 5 to 5"),
        ("energy_balance", "[]", ""),
        ("energy_balance", '{"roulette": 0.5}', ""),
        ("energy_balance", f'{{"roulette": {10**40}}}', ""),
        ("counters", '{"after_gate": null}', ""),
        ("timing", '{"transport": NaN}', ""),
        ("provenance", '{"parts": 3}', ""),
        ("provenance", "[" * 100_000, ""),
        ("config", "[medium]\nextinction = nan", ""),
        ("config", "a." * 50_000 + "a = 1", ""),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else None,
)
def test_values_that_no_run_writes_are_refused(result, tmp_path, name, value, words):
    path = result.save(tmp_path / "result.h5")
    gc.collect()  # else an array of another test may end, and fail to, where the parser is nested most deeply
    with h5py.File(path, "r+") as file:
        if value is None:
            del file.attrs[name]
        elif isinstance(value, str):
            del file[name]
            file[name] = value
        else:
            file[name][...] = value
    with pytest.raises(FileError, match=rf"result\.h5: not a whole spadwarp result: {words}"):
        load_result(path)


def test_results_that_count_different_things_are_not_added(result):
    other = dataclasses.replace(result, photon_ranges=((10**9, 2 * 10**9),), requested=(10**9, 2 * 10**9))
    for name in ("energy_balance", "counters"):
        with pytest.raises(ConfigError, match=f"in their {name}: spam"):
            merge([result, dataclasses.replace(other, **{name: {**getattr(other, name), "spam": 0}})])


# EXR


def test_truth_and_depth_survive_exr(result, tmp_path):
    path = save_truth_maps(result, tmp_path / "truth.exr")
    again = load_truth_maps(path)
    for name in TRUTH:
        np.testing.assert_array_equal(getattr(again, name), getattr(result.truth, name), strict=True)
    # The names that other programs look for, in 32-bit floats.
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert set(file.channels()) == {"Z", "range", "N.X", "N.Y", "N.Z", "R", "G", "B"}
        assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(np.float32)}
        assert file.header()["Z"] == "planar depth [m]" and file.header()["seed"] == "7"

    depth = result.truth.depth.astype(np.float64) + 0.01
    channels, metadata = read_exr(save_depth_exr(result, depth, tmp_path / "depth.exr"))
    np.testing.assert_array_equal(channels["Z"], depth.astype(np.float32), strict=True)
    assert metadata["content"] == "measured depth"
    with pytest.raises(FileError, match=r"not truth maps: no channel range, N\.X"):
        load_truth_maps(tmp_path / "depth.exr")


# Files that a scene names, changed since


ANGLES = np.linspace(0.0, 180.0, 361)


def write_phase_table(path, g):
    cosine = np.cos(np.radians(ANGLES))
    density = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
    rows = np.column_stack([ANGLES, density])
    np.savetxt(path, rows, delimiter=",", header="angle_deg,phase_function", comments="", fmt="%.9g")


def write_profile(path, radius):
    image = np.zeros((8, 8))
    image[4 - radius : 4 + radius, 4 - radius : 4 + radius] = 1.0
    np.save(path, image)


def write_mesh(path, width):
    trimesh.creation.box((width, 2.0, 0.2)).export(path)


CASES = {
    "phase table": (
        "phase.csv",
        write_phase_table,
        (0.9, 0.5),
        {"medium": {"phase_function": "tabulated"}},
        "medium.phase_table",
    ),
    "beam": (
        "beam.npy",
        write_profile,
        (2, 3),
        {"laser": {"profile": "measured", "half_angle_deg": 20.0}},
        "laser.profile_image",
    ),
    "mesh": ("box.stl", write_mesh, (2.0, 2.0001), {"targets": [{"translation": [0.0, 0.0, 2.0]}]}, "targets.0.mesh"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_changed_file_is_named_by_resume_and_merge(tmp_path, case):
    name, write, (before, after), sections, key = CASES[case]
    path = tmp_path / name
    write(path, before)
    part, *fields = key.split(".")
    if part == "targets":
        sections = {"targets": [{**sections["targets"][0], "mesh": str(path)}]}
    else:
        sections = {part: {**sections[part], fields[0]: str(path)}}
    whole = scene(**sections)
    first = spadwarp.simulate(whole, photons=2000, device="cpu")
    first.save(tmp_path / "result.h5")
    kept = spadwarp.load(tmp_path / "result.h5")
    assert kept.file_hashes == first.file_hashes and len(kept.file_hashes) == len(whole.files) == 1
    longer = spadwarp.simulate(whole, photons=4000, device="cpu", run=spadwarp.RunOptions(resume=kept))
    assert longer.photons == 4000

    write(path, after)
    with pytest.raises(ConfigError, match=f"{name} is another file than it was"):
        spadwarp.simulate(whole, photons=4000, device="cpu", run=spadwarp.RunOptions(resume=kept))
    second = spadwarp.simulate(whole, photons=2000, device="cpu", run=spadwarp.RunOptions(first_photon=2000))
    with pytest.raises(ConfigError, match=f"{name} is another file than it was"):
        spadwarp.merge([kept, second])


def test_a_changed_mesh_of_a_dataset_is_named(tmp_path):
    """Also one that its recipe names by its folder."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    write_mesh(meshes / "box.stl", 1.0)
    small = recipe(
        **{"frames.per_scene": 1, "targets": {"builtin": [], "meshes": [str(meshes)], "validation": [], "test": []}}
    )
    make(small, tmp_path / "data", part=(2, 2))
    write_mesh(meshes / "box.stl", 1.1)
    with pytest.raises(FileError, match=r"box\.stl is another file than it was"):
        make(small, tmp_path / "data")
