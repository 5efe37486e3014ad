"""Histograms, time axis, ranges and energy balance of a result."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.synthetic_result import UNIT, make_result, make_scene
from spadwarp.result import COMPONENTS
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.sight import range_from_path

SPEED = 299_792_458.0 / 1.3638


@pytest.fixture(scope="module")
def result():
    return make_result(make_scene())


def test_histograms_and_their_axis(result):
    """Components sum to the histogram and carry its unit; bins are half open from the gate's start, paths geometric."""
    np.testing.assert_allclose(result.histogram, sum(result.component(name) for name in COMPONENTS), rtol=1e-12)
    assert result.histogram[3, 4, 40] == result.tallies[:, 3, 4, 40].sum() * UNIT / result.photons
    np.testing.assert_allclose(result.intensity, result.histogram.sum(-1), rtol=1e-12)
    # 37.5 nJ at 532 nm: E0·λ/(hc); PDE = 0.247 · 0.2
    photons = 37.5e-9 * 532e-9 / (6.62607015e-34 * 299_792_458.0)
    np.testing.assert_allclose(result.detections, result.histogram * photons * 0.247 * 0.2, rtol=1e-12)
    gate, edges = result.scene.gate, result.bin_edges
    assert edges.shape == (gate.bins + 1,) and edges[0] == gate.start
    np.testing.assert_allclose(np.diff(edges), gate.bin_width, rtol=1e-9)
    np.testing.assert_allclose(result.bin_centres, (edges[1:] + edges[:-1]) / 2)
    np.testing.assert_allclose(result.path_edges, edges * SPEED)
    with pytest.raises(ValueError, match="'ballistic', 'forward_scattered', 'backscatter'"):
        result.component("fluorescent")
    with pytest.raises(ValueError, match="quantity = 'height'"):
        result.depth(quantity="height")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("unit", 0.3, "not a power of two"),
        ("photons", 0, "photons = 0"),
        ("photon_ranges", ((0, 5),), "5 ids"),
        ("tallies", np.zeros((3, 12, 16, 47), dtype=np.int64), r"int64 \(3, 12, 16, 48\)"),
        ("tallies", np.zeros((3, 12, 16, 48)), "tallies: float64"),
    ],
)
def test_arrays_and_numbers_that_do_not_fit_the_scene_are_refused(result, field, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(result, **{field: value})


# Depth


@pytest.mark.parametrize("laser", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-1.5, 0.7, 0.4)])
def test_depth_frame_finds_the_target_within_a_bin(laser):
    result = make_result(make_scene(laser={"position": laser}))
    depth, truth = result.depth(method="peak"), result.truth.depth
    seen = np.isfinite(truth)
    assert seen.sum() == 12 * 12  # the plate is 4 m wide and the view 5.25 m
    bin_path = result.path_edges[1] - result.path_edges[0]
    # A bin centre is at most half a bin of path from the arrival, and dr/dL = 1/(1 + cos) of the angle at the target.
    assert np.abs(depth - truth)[seen].max() < 0.6 * bin_path
    distance = result.depth(method="peak", quantity="range")
    np.testing.assert_allclose(distance * pixel_directions(result.scene.camera)[..., 2], depth)


def test_range_is_nan_for_paths_shorter_than_the_baseline():
    assert np.isnan(range_from_path([0.5, 1.0, -3.0, np.nan], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])).all()


@given(
    laser=st.tuples(*[st.floats(-3, 3)] * 3),
    direction=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda u: np.linalg.norm(u) > 0.01),
    distance=st.floats(0.01, 100),
)
def test_range_from_path_undoes_the_path(laser, direction, distance):
    u = np.array(direction) / np.linalg.norm(direction)
    path = np.linalg.norm(distance * u - laser) + distance
    if path - np.linalg.norm(laser) > 1e-6:  # else the target lies between lens and laser: any point has this path
        np.testing.assert_allclose(range_from_path(path, u, laser), distance, rtol=1e-6)


# Accounts


def test_the_energy_balance_is_exact_and_names_what_is_missing(result):
    report = result.energy_report()
    assert report["exact"] and report["difference"] == 0
    assert report["fractions"] == {"absorbed_water": 0.75, "weight_cutoff": 0.5, "roulette": -0.25}
    less = {**result.energy_balance, "absorbed_water": result.energy_balance["absorbed_water"] - 1}
    leaky = dataclasses.replace(result, energy_balance=less).energy_report()
    assert not leaky["exact"] and leaky["difference"] == 1


def test_summary_is_plain_numbers(result):
    summary = json.loads(json.dumps(result.summary()))
    assert summary["photons"] == 10**9
    np.testing.assert_allclose(sum(summary["collected_fraction"].values()), result.histogram.sum(), rtol=1e-12)
    np.testing.assert_allclose(summary["detections_per_pulse"], result.detections.sum(), rtol=1e-12)
    assert summary["truth"]["depth_m"] == pytest.approx([14.29, 14.79], abs=1e-5)
    nothing = make_result(make_scene(), empty=True)
    assert nothing.summary()["pixels_with_return"] == 0 and np.isnan(nothing.depth()).all()
