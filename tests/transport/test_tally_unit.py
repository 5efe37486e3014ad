"""The tally holds the brightest bin and resolves the faintest light, and what it cannot do it says."""

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import spadwarp
import spadwarp_kernels as sk
from helpers.launch import Floats, launched
from helpers.scenes import BEYOND, PENCIL, PLATE, scene
from spadwarp import RunOptions, simulate
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport import PHOTON_CAPACITY, TallyLimits, tally_limits
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.values import ConfigError, SpadwarpError, path_from_time
from spadwarp_kernels.photon.state import to_fixed_point


def plate_at(distance, extinction, *, reflectance=0.5, estimator="next_event"):
    """A pencil beam onto a plate across the axis; a history ends at its first event, which is all of the ballistic
    return."""
    return scene(
        medium={"extinction": extinction, "anisotropy": 0.924},
        laser=PENCIL,
        camera={"width": 1, "height": 1, "horizontal_fov_deg": 2.0, "aperture_diameter": 0.05},
        gate={"bin_width_ps": 1000.0, "bins": 100},
        targets=[{**PLATE, "size": [4.0, 4.0], "translation": [0, 0, distance], "reflectance": reflectance}],
        transport={"estimator": estimator, "max_collisions": 1},
    )


def one_return(one, distance):
    """Light of one photon that has reached the plate, by the lidar equation."""
    reflectance, area = one.targets[0].reflectance, one.camera.aperture_area
    return reflectance / math.pi * math.exp(-one.medium.extinction * distance) * area / distance**2


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_a_far_target_is_seen_behind_a_bright_bin_at_the_lens(estimator, device):
    """One pixel, wide bins, a gate from 0: 19 attenuation lengths, within 3 standard errors of the lidar equation, and
    within the rounding of the photons that have reached the plate."""
    one = plate_at(8.0, 1.2, estimator=estimator)
    photons = 4_000_000
    result = simulate(one, photons=photons, seed=1, device=device)
    reached = result.counters["surface_events"]
    value = result.component("ballistic").sum() * photons
    assert value == pytest.approx(reached * one_return(one, 8.0), rel=0.005)
    expected = photons * math.exp(-1.2 * 8.0)
    assert abs(value / one_return(one, 8.0) - expected) < 3 * math.sqrt(expected)
    assert result.counters["clipped"] == 0 and not result.counters["below_unit_ballistic"]


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    distance=st.floats(1.5, 30.0),
    depth=st.floats(0.05, 5.0),
    pixels=st.integers(1, 64),
    view=st.floats(1.0, 60.0),
    aperture=st.floats(0.002, 0.05),
    bin_width=st.floats(50.0, 50_000.0),
    start=st.floats(0.0, 0.9),
    reflectance=st.floats(0.01, 1.0),
    seed=st.integers(0, 2**32),
)
@pytest.mark.physics
def test_the_ballistic_return_meets_the_closed_form_in_any_scene(distance, depth, seed, **drawn):
    """Of the photons that have reached the plate, to 4.5 standard errors of rounding and the finite lens."""
    one = plate_at(distance, depth / distance, reflectance=drawn["reflectance"])
    speed = path_from_time(1e-9, one.medium.group_index)  # per ns
    start = drawn["start"] * 2 * distance / speed
    bins = math.ceil((2.2 * distance / speed - start) * 1000.0 / drawn["bin_width"])
    camera = {"width": drawn["pixels"], "horizontal_fov_deg": drawn["view"], "aperture_diameter": drawn["aperture"]}
    gate = {"start_ns": start, "bin_width_ps": drawn["bin_width"], "bins": bins}
    one = one.with_overrides(camera=camera, gate=gate)
    result = simulate(one, photons=100_000, seed=seed, device="cpu")
    reached, value = result.counters["surface_events"], one_return(one, distance) / result.unit
    assert reached > 100
    units = int(result.tallies[0].sum())
    assert abs(units - reached * value) < 4.5 * math.sqrt(reached * min(0.25, value)) + 1e-3 * reached * value
    assert result.counters["below_unit_ballistic"] in (0, reached) and result.counters["clipped"] == 0


# Both ends


def test_the_unit_is_as_fine_as_the_furthest_target_needs():
    """And as coarse as all photons allow where that suffices."""
    for distance, extinction, needs_more in [(5.0, 0.3, False), (8.0, 1.2, True)]:
        one = plate_at(distance, extinction)
        mesh = build_mesh(one)
        scale, capacity = tally_limits(one, mesh)
        units = one_return(one, distance) * scale
        assert (capacity < PHOTON_CAPACITY) == needs_more
        assert capacity >= PHOTON_CAPACITY / 16
        assert units > 1


@pytest.mark.parametrize(
    "water",
    [
        {"phase_function": "two_term_henyey_greenstein", "g1": 0.9, "g2": -0.6, "alpha": 0.8},
        {"phase_function": "fournier_forand"},
    ],
)
def test_the_brightest_bin_follows_the_phase_function(water, device):
    """Near backscatter of a coaxial beam, in a histogram that has converged."""
    one = scene(
        medium={"extinction": 1.0, "albedo": 0.9, **water},
        laser={"position": [0.0, 0.0, 0.0], "half_angle_deg": 5.0},
        camera={"width": 1, "height": 1, "aperture_diameter": 0.05},
        targets=BEYOND,
    )
    result = simulate(one, photons=100_000, seed=2, device=device)
    fill = result.tallies.sum(axis=0).max() / result.photons * tally_limits(one, build_mesh(one)).photons / 2.0**62
    assert 1e-5 < fill < 0.5


def test_more_photons_than_the_tally_holds_are_refused():
    one = plate_at(8.0, 1.2)
    capacity = tally_limits(one, build_mesh(one)).photons
    with pytest.raises(ConfigError, match=rf"photons = {10**12} is outside \[1, {capacity}\]"):
        simulate(one, photons=10**12, device="cpu")


def test_an_overflow_is_an_error_and_not_a_histogram(monkeypatch):
    one = scene(transport={"estimator": "analog"})
    monkeypatch.setattr("spadwarp.transport.plan.tally_limits", lambda *_: TallyLimits(2.0**57, PHOTON_CAPACITY))
    with pytest.raises(SpadwarpError, match="a histogram bin overflowed"):
        simulate(one, photons=200_000, device="cpu")
    for values, expected in [([0, 2**62 - 1], False), ([5, 2**62], True), ([-1, 0], True)]:
        assert sk.has_overflowed(wp.array(values, dtype=wp.int64, device="cpu")) == expected


def test_a_merge_beyond_the_tally_is_refused():
    one = scene()
    parts = [simulate(one, photons=1000, seed=1, device="cpu", run=RunOptions(first_photon=1000 * k)) for k in range(2)]
    full = [dataclasses.replace(part, tallies=np.where(part.tallies > 0, 2**61, 0)) for part in parts]
    with pytest.raises(SpadwarpError, match="a histogram bin overflowed"):
        spadwarp.merge(full)


# Rounding


@wp.kernel(enable_backward=False)
def _rounded(units: Floats, ups: wp.array(dtype=wp.int64)):
    """Sum over all 2^24 samples."""
    i = wp.tid()
    total = wp.int64(0)
    for k in range(1 << 24):
        total += to_fixed_point(units[i], sk.u01(wp.uint32(k) << wp.uint32(8)))
    ups[i] = total


def test_rounding_keeps_means(device):
    """Over all samples: to 2^-25 unit, or to 2^-24 of the value."""
    units = np.array([3e-8, 1e-6, 0.001, 0.2500001, 0.9999999, 1.3, 5.2512345, 1e5 + 0.3, 2e6], np.float32)
    (total,) = launched(_rounded, [units], [wp.int64], device)
    np.testing.assert_allclose(total / 2.0**24, units.astype(float), atol=2.0**-25, rtol=2.0**-24)


@pytest.mark.physics
def test_contributions_below_one_unit_are_counted_and_keep_their_mean(device):
    """A unit 2^20 and 2^30 times coarser: the same light on average, to the rounding error that the counters tell."""
    one = scene(transport={"estimator": "next_event"})
    mesh = build_mesh(one)
    model, spec = build_model(one, pick_device(device), mesh), transport_spec(one, mesh)
    totals, errors = [], []
    for coarser in (1.0, 2.0**20, 2.0**30):
        data = sk.make_data(changed := dataclasses.replace(model, scale=model.scale / coarser))
        sk.launch_transport(spec, changed, data, seed=5, first_id=0, photon_count=200_000)
        totals.append(data.tally.numpy().reshape(3, -1).sum(axis=1) * coarser)
        counters = sk.read_ledger(data)[1]
        small = [counters[f"below_unit_{name}"] for name in sk.COMPONENTS]
        errors.append(coarser * np.sqrt(np.minimum(np.array(small) / 4.0, totals[-1] / coarser)))
        assert sum(small) <= counters["contributions"] and (coarser == 1.0) == (sum(small) == 0)
    for total, error in zip(totals[1:], errors[1:], strict=True):
        assert (np.abs(total - totals[0]) < 4.5 * error + 1e-6 * totals[0]).all()
    assert (errors[2] > 0.01 * totals[0]).any()


def test_rounding_that_decides_the_error_is_a_warning():
    """30 attenuation lengths of water behind a gate from 0."""
    one = scene(
        medium={"extinction": 8.0, "albedo": 0.5},
        targets=[{**PLATE, "translation": [0.0, 0.0, 2.0], "reflectance": 0.5}],
        gate={"bins": 4, "bin_width_ps": 3e4},
        transport={"estimator": "next_event", "max_collisions": 60, "weight_cutoff": 0.0},
    )
    with pytest.warns(RuntimeWarning, match=r"rounding to the histogram's unit .* contributions of less than one unit"):
        result = simulate(one, photons=100_000, device="cpu")
    assert max(result.rounding_error.values()) > 0.05
    assert max(simulate(scene(), photons=20_000, device="cpu").rounding_error.values()) < 1e-3
