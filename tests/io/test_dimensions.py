"""Named dimensions and coordinates: our files as xarray opens them, by both of its readers of netCDF-4."""

import dataclasses

import numpy as np
import pytest

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import record_frames
from spadwarp.transport import save_records, trace

xarray = pytest.importorskip("xarray")

WIDTH, HEIGHT, BINS = 6, 4, 24
ENGINES = ("h5netcdf", "netcdf4")


@pytest.fixture(scope="module")
def result():
    result = make_result(make_scene(width=WIDTH, height=HEIGHT, bins=BINS))
    moments = np.arange(2 * result.histogram.size, dtype=np.uint64).reshape(2, *result.histogram.shape)
    return dataclasses.replace(result, half=result.tallies, second_moment=moments, batch_size=result.photons, batches=1)


@pytest.fixture(params=ENGINES)
def opened(request, tmp_path):
    pytest.importorskip("netCDF4" if request.param == "netcdf4" else request.param)
    trees = []

    def open_tree(path):
        trees.append(xarray.open_datatree(path, engine=request.param))
        for group in trees[-1].subtree:
            assert not [name for name in group.sizes if "phony" in name], group.path
        return trees[-1].load()

    yield open_tree
    for tree in trees:
        tree.close()


def test_results(result, opened, tmp_path):
    tree = opened(result.save(tmp_path / "result.h5"))
    assert tree.tallies.dims == ("component", "y", "x", "time")
    assert tree.second_moment.dims == ("word", "y", "x", "time")
    np.testing.assert_array_equal(tree.time, result.bin_centres)
    assert tree.time.attrs["units"] == "s"
    fraction = tree.tallies.sel(component="backscatter") * (tree.attrs["unit"] / tree.attrs["photons"])
    np.testing.assert_array_equal(fraction, result.component("backscatter"))
    truth = tree["truth"]
    assert truth.normal.dims == ("y", "x", "axis") and truth["depth"].attrs["units"] == "m"
    np.testing.assert_array_equal(truth.normal.sel(axis="z"), result.truth.normal[..., 2])


@pytest.mark.parametrize("measured", [False, True])
def test_frames(result, opened, measured, tmp_path):
    if measured:
        times = np.linspace(-1000, 1000, 21)
        table = np.stack([times, np.exp(-((times / 400) ** 2))], axis=1)
        np.savetxt(tmp_path / "irf.csv", table, delimiter=",", header="time_ps,value", comments="")
        scene = result.scene.with_overrides({"detector.irf": str(tmp_path / "irf.csv")})
        result = dataclasses.replace(result, scene=scene)
    path = tmp_path / "frames.h5"
    record_frames(result, path, pulses=500, frames=3, seed=3, tags=not measured, device="cpu")
    tree = opened(path)
    assert tree.counts.dims == ("frame", "y", "x", "time") and tree.counts.shape == (3, HEIGHT, WIDTH, BINS)
    assert tree["depth"].matched.dims == ("frame", "y", "x")
    np.testing.assert_array_equal(tree.counts.sum("time"), tree.intensity)
    if measured:
        assert tree.irf.dims == ("quantity", "sample") and tree.irf.sizes["sample"] >= 21
    else:
        assert tree["tags"]["bin"].dims == ("detection",)
        assert tree["tags"].sizes["detection"] == tree.counts.sum() > 0


def test_analytic_files_and_records(opened, tmp_path):
    scene = make_scene(width=WIDTH, height=HEIGHT, bins=BINS)
    analytic = spadwarp.simulate_analytic(scene, frames=2, seed=5, device="cpu")
    tree = opened(analytic.save(tmp_path / "analytic.h5"))
    assert tree["depth"].dims == ("frame", "y", "x") and tree["maps"].sigma_time.attrs["units"] == "s"
    np.testing.assert_array_equal(tree["depth"], analytic.depth)
    np.testing.assert_array_equal(tree.labels, analytic.labels)
    records = trace(scene.with_overrides({"targets": []}), photons=200, seed=1, device="cpu")
    tree = opened(save_records(records, tmp_path / "records.h5"))
    assert tree.position.dims == ("photon", "axis")
    np.testing.assert_array_equal(tree.position.sel(axis="z"), records.position[:, 2])
