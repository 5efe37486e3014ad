"""The table medium.grid: files, shapes, optical depths, messages."""

import math

import h5py
import numpy as np
import pytest
import warp as wp

import spadwarp
from helpers.scenes import scene
from spadwarp.scene import Scene
from spadwarp.scene.grid import read_grid, turbulent_field
from spadwarp.scene.medium import grid_cells

RNG = np.random.default_rng(11)
DENSITY = RNG.random((3, 4, 5))
CLOUD = {"shape": "cloud", "size": [1.0, 2.0, 1.5], "cells": 20, "extinction": 2.0, "translation": [0.0, 0.0, 1.2]}


def medium(**grid):
    return scene(medium={"grid": grid}).medium


def test_density_adds_to_the_medium(tmp_path):
    path = tmp_path / "cells.npz"
    np.savez(path, density=DENSITY, cell_size=0.1)
    water = medium(file=str(path), extinction=2.0, albedo=0.5, anisotropy=0.2)
    cells = grid_cells(water)
    assert cells.size == pytest.approx((0.3, 0.4, 0.5)) and cells.centre == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(cells.extinction, 0.5 + 2.0 * DENSITY, rtol=1e-6)
    np.testing.assert_allclose(cells.scattering, 0.4 + 1.0 * DENSITY, rtol=1e-5)
    # The mean cosine of both scatterings together.
    np.testing.assert_allclose(cells.anisotropy, (0.4 * 0.8 + DENSITY * 0.2) / (0.4 + DENSITY), rtol=1e-5)


@pytest.mark.parametrize(
    "names", ["absorption scattering", "extinction albedo", "scattering albedo", "absorption albedo"]
)
def test_two_coefficients_of_a_file_are_the_water(tmp_path, names):
    b, a = DENSITY, 0.1 + DENSITY[::-1]
    values = {"absorption": a, "scattering": b, "extinction": a + b, "albedo": b / (a + b)}
    path = tmp_path / "cells.h5"
    with h5py.File(path, "w") as file:
        for name in names.split():
            file[name] = values[name]
        file["size"], file["origin"] = [3.0, 4.0, 5.0], [-1.0, 0.0, 2.0]
    cells = grid_cells(medium(file=str(path), scale=2.0, translation=[0.0, 1.0, 0.0]))
    np.testing.assert_allclose(cells.extinction, a + b, rtol=1e-5)
    np.testing.assert_allclose(cells.albedo, b / (a + b), rtol=1e-5)
    assert cells.size == (6.0, 8.0, 10.0) and cells.centre == pytest.approx((1.0, 5.0, 9.0))


def test_a_nanovdb_file_is_the_density_at_its_own_place(tmp_path):
    path = tmp_path / "smoke.nvdb"
    values = np.zeros((10, 12, 9), np.float32)
    values[2:5, 3:7, 1:6] = DENSITY
    volume = wp.Volume.load_from_numpy(values, min_world=(1.0, 2.0, 3.0), voxel_size=0.1, bg_value=0.0, device="cpu")
    volume.save_to_nvdb(path)
    found = read_grid(path)
    density = found.arrays["density"][0]
    # A voxel's index stands at its middle, 1 m for the first.
    low = np.round((np.array(found.origin) + 0.05 - [1.0, 2.0, 3.0]) / 0.1).astype(int)
    part = density[tuple(slice(k, k + n) for k, n in zip([2, 3, 1] - low, DENSITY.shape, strict=True))]
    np.testing.assert_allclose(part, DENSITY, rtol=1e-6)
    assert density.sum() == pytest.approx(DENSITY.sum(), rel=1e-5)
    np.testing.assert_allclose(found.size, 0.1 * np.array(density.shape), rtol=1e-6)
    cells = grid_cells(medium(file=str(path), extinction=1.0))
    assert cells.extinction.max() == pytest.approx(0.5 + DENSITY.max(), rel=1e-5)


def test_frames_of_a_file_are_interpolated(tmp_path):
    path = tmp_path / "cells.npz"
    np.savez(path, density=np.stack([DENSITY, 3.0 * DENSITY, DENSITY]), size=[1.0, 1.0, 1.0])
    for frame, factor in ((0.0, 1.0), (0.25, 1.5), (1.0, 3.0), (2.0, 1.0)):
        cells = grid_cells(medium(file=str(path), frame=frame))
        np.testing.assert_allclose(cells.extinction, 0.5 + factor * DENSITY, rtol=1e-6)
    with pytest.raises(spadwarp.ConfigError, match=r"medium\.grid\.frame = 2\.5 is outside \[0, 2\]"):
        grid_cells(medium(file=str(path), frame=2.5))


def test_a_trajectory_moves_the_water(tmp_path):
    table = tmp_path / "drift.csv"
    table.write_text("time,medium.grid.translation[0],medium.grid.frame\n0,0.0,0\n1,0.5,0.25\n")
    base = scene(medium={"grid": {**CLOUD, "turbulence": 0.5}})
    first, last = spadwarp.scene.load_trajectory(table).scenes(base)
    assert first.medium.grid.translation == (0.0, 0.0, 1.2) and last.medium.grid.translation == (0.5, 0.0, 1.2)
    one, other = grid_cells(first.medium), grid_cells(last.medium)
    correlation = np.corrcoef(np.log(one.extinction - 0.4999).ravel(), np.log(other.extinction - 0.4999).ravel())[0, 1]
    assert 0.8 < correlation < 0.9999


@pytest.mark.parametrize("shape", ["cloud", "plume", "sediment", "gradient"])
def test_shapes_are_placed_as_targets_are(shape):
    """A quarter turn about x puts the box's down, +y, behind."""
    plain, turned = (
        grid_cells(medium(shape=shape, size=[1.0, 1.0, 1.0], cells=16, **place))
        for place in ({}, {"rotation_deg": [90.0, 0.0, 0.0], "translation": [0.0, 0.0, 3.0], "scale": 2})
    )
    assert 0.5 < (plain.extinction - 0.5).max() <= 1.0
    np.testing.assert_array_equal(plain.extinction, turned.extinction)
    points = np.array([[0.1, 0.3, -0.2], [0.0, 0.45, 0.0], [2.0, 0.0, 0.0]])
    moved = 2.0 * points[:, [0, 2, 1]] * [1.0, -1.0, 1.0] + [0.0, 0.0, 3.0]
    np.testing.assert_allclose(plain.at(points, 0.5), turned.at(moved, 0.5))


def test_turbulence_has_unit_variance_its_spectrum_and_its_seed():
    counts, edges = (64, 64, 64), (2.0, 2.0, 2.0)
    field = turbulent_field(counts, edges, 0.5, seed=1)
    assert field.mean() == pytest.approx(0.0, abs=1e-9) and field.std() == pytest.approx(1.0)
    np.testing.assert_array_equal(field, turbulent_field(counts, edges, 0.5, seed=1))
    assert np.abs(np.corrcoef(field.ravel(), turbulent_field(counts, edges, 0.5, seed=2).ravel())[0, 1]) < 0.1
    # Far above the largest eddies: power by mode as k^(-11/3).
    power = np.abs(np.fft.fftn(field)) ** 2
    k = np.linalg.norm(np.meshgrid(*[2.0 * np.pi * np.fft.fftfreq(64, 1 / 32)] * 3, indexing="ij"), axis=0)
    shells = [power[(k > low) & (k < 1.2 * low)].mean() for low in (40.0, 80.0)]
    assert math.log2(shells[0] / shells[1]) == pytest.approx(11.0 / 3.0, abs=0.35)
    np.testing.assert_allclose(turbulent_field(counts, edges, 0.5, 1, 0.0), field)


def test_optical_depths_through_a_cloud():
    one = scene(medium={"grid": {**CLOUD, "cells": [41, 41, 40]}})
    posed = one.with_overrides({"camera.position": [0.0, 0.0, 3.0], "camera.rotation_deg": [0.0, 180.0, 0.0]})
    near, far, sigma = (0.0, 0.0, 0.0), (0.0, 0.0, 3.0), 1.5 / 6.0
    expected = 0.5 * 3.0 + 2.0 * sigma * math.sqrt(2.0 * math.pi) * math.erf(3.0 / math.sqrt(2.0))
    for found in (one.optical_depth(near, far), one.optical_depth(far, near), posed.optical_depth(near, far)):
        assert found == pytest.approx(expected, rel=2e-3)
    assert one.optical_depth((5.0, 0.0, 0.0), (5.0, 0.0, 3.0)) == pytest.approx(1.5)
    assert one.optical_depth(near, (0.0, 0.0, 1e30)) == pytest.approx(0.5e30)
    assert np.isnan(one.optical_depth(near, np.full(3, np.nan)))  # of a pixel that sees no target, without a warning


def test_files_are_found_beside_the_scene_and_overrides_reach_a_grid(tmp_path):
    one = scene(medium={"grid": CLOUD})
    assert one.with_overrides(["medium.grid.extinction=3"]).medium.grid.extinction == 3.0
    assert one.with_overrides({"medium.grid": None}).medium.grid is None
    np.savez(tmp_path / "a.npz", density=DENSITY, size=[1.0, 1.0, 1.0])
    tables = {**one.to_dict(), "medium": {"extinction": 0.5, "albedo": 0.8, "grid": {"file": "a.npz"}}}
    filed = Scene.from_dict(tables, source=tmp_path / "scene.toml")
    assert filed.medium.grid.file == str(tmp_path / "a.npz") and filed.files[-1] == tmp_path / "a.npz"
    assert Scene.from_toml(filed.to_toml()) == filed


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({"density": DENSITY[0]}, "density is float64 (4, 5); numbers [x, y, z] or [frame, x, y, z]"),
        ({"density": -DENSITY}, "is outside [0, 1e9]"),
        ({"density": DENSITY * np.nan}, "= nan is outside [0, 1e9]"),
        ({"albedo": DENSITY}, "holds albedo; density, or two of extinction"),
        ({"extinction": DENSITY, "albedo": DENSITY[1:]}, "arrays of different shapes"),
        ({"density": DENSITY, "size": [1.0, 0.0, 1.0]}, "size = [1.0, 0.0, 1.0] is not three numbers in (0, inf)"),
        ({"density": DENSITY}, "needs size;"),
        ({"smoke": DENSITY}, "holds none of them"),
        *((ending, f"cells.{ending}") for ending in ("npz", "h5", "nvdb")),
    ],
)
def test_files_that_are_no_cells_are_refused_by_name(tmp_path, content, text):
    path = tmp_path / f"cells.{content if isinstance(content, str) else 'npz'}"
    if isinstance(content, str):
        path.write_bytes(b"PK\x03\x04" + bytes(range(200)))
    else:
        np.savez(path, **content)
    with pytest.raises(spadwarp.SpadwarpError) as caught:
        grid_cells(medium(file=str(path)))
    assert text in str(caught.value) and path.name in str(caught.value)


def test_check_says_what_the_cells_do():
    def found(**changes):
        changed = one.with_overrides({f"medium.grid.{name}": value for name, value in changes.items()})
        return {message.field: message for message in spadwarp.check(changed)}

    one = scene(medium={"grid": CLOUD}, camera={"aperture_diameter": 0.02})
    numbers = spadwarp.checks.summary(one)["grid"]
    assert numbers["cells"] == [10, 20, 15] and numbers["bytes"] == 3000 * 8
    note = found()["medium.grid"]
    assert note.level == "note" and "optical depth along the axis" in note.text
    warning = found(translation=[50.0, 0.0, 1.2])["medium.grid"]
    assert warning.level == "warning" and "beside the view" in warning.text
    assert "medium.grid.cells" in found(cells=2, extinction=50.0)
