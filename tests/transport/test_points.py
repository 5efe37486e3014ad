"""Several points of a flight: the expectation of one point, less noise in the bins of a pixel, and what is refused."""

import numpy as np
import pytest

import spadwarp
from helpers.estimators import cells
from helpers.runs import of_seeds
from helpers.scenes import BEYOND, ELSEWHERE, scene
from helpers.statistics_of_samples import DEVICES, equal_means_p
from spadwarp import simulate
from spadwarp.transport import points_per_flight
from spadwarp.values import ConfigError

BARS = [
    {"builtin": "box", "size": [3.0, 3.0, 0.1], "translation": [0.0, 0.0, 2.3], "reflectance": 0.7},
    {"builtin": "box", "size": [0.3, 2.0, 0.4], "translation": [-0.3, 0.0, 1.8], "reflectance": 0.5},
    {"builtin": "box", "size": [0.3, 2.0, 0.4], "translation": [0.4, 0.0, 1.5], "reflectance": 0.5},
]
LAYERS = {"layers": [{"start": 0.8, "extinction": 1.0, "albedo": 0.6}]}
ONE_WATER = {"layers": ELSEWHERE}

POLARISED = {"medium": {"scattering_matrix": "scaled_rayleigh"}, "camera": {"polarisation": "stokes"}}


def with_points(one, points):
    return one.with_overrides({"transport.estimator": "guided", "transport.points_per_flight": points})


@pytest.mark.physics
@pytest.mark.slow
def test_more_points_have_the_expectation_of_one(device):
    """In layers, behind boxes that hide water from the lens, so that later points trace shadow rays of their own."""
    one, more = (cells(with_points(scene(medium=LAYERS, targets=BARS), n), device, 8000, pixels=True) for n in (1, 3))
    assert equal_means_p(one, more) > 1e-3
    for found in (one, more):
        assert found.sum(axis=1).std() / found.sum(axis=1).mean() / np.sqrt(len(found)) < 0.015


@pytest.mark.slow
@pytest.mark.physics
def test_more_points_leave_less_noise_in_the_bins_of_a_pixel(device):
    """Variance of 32 × 32 pixels' bins in water over 24 seeds: 1/3 if they were independent, a little more as the
    points of a flight share its photon."""
    sections = {
        "camera": {"width": 32, "height": 32, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
        "gate": {"bins": 16, "bin_width_ps": 1000.0},
        "targets": BEYOND,
    }

    def variance(points):
        one = with_points(scene(**sections, medium=ONE_WATER if points == 3 else {}), points)
        light = [run.light.sum(axis=0) for run in of_seeds(one, device, 20_000, range(24))]
        return np.var(light, axis=0).sum(axis=(0, 1))[2:8]

    single, triple = (variance(points) for points in (1, 3))
    assert 0.25 < np.median(triple / single) < 0.55


@pytest.mark.parametrize("device", DEVICES[1:])
@pytest.mark.parametrize("kind", ["derivatives", "polarised in cells"])
def test_three_points_where_a_warp_has_a_short_queue(kind, device, tmp_path):
    """A round of flights adds three times as many requests as a warp of a GPU scores at a time: sums over all bins of
    light, or its derivative, that a flight and the surface at its end bring agree within errors."""
    names = ["medium.absorption", "medium.scattering", "medium.anisotropy", "reflectance"]
    sections, names = ({}, names) if kind == "derivatives" else (POLARISED, [])
    np.savez(tmp_path / "cells.npz", extinction=np.full((2, 2, 2), 0.5), albedo=np.full((2, 2, 2), 0.8), size=[9.0] * 3)
    cells = {"grid": {"file": str(tmp_path / "cells.npz"), "tracking": "regular"}}

    def totals(points):
        medium = cells if points == 3 and not names else ONE_WATER
        one = with_points(scene(**sections | {"medium": sections.get("medium", {}) | medium}), points)
        rows = []
        for seed in range(12):
            result = simulate(one, photons=20_000, seed=seed, device=device, derivatives=names)
            assert result.counters["invalid"] == 0 and result.counters["clipped"] == 0
            rows.append(result.derivatives["medium.scattering"].sum() if names else result.histogram.sum())
        return np.array(rows)

    one, three = totals(1), totals(3)
    assert abs(one.mean() - three.mean()) < 4 * np.sqrt((one.var(ddof=1) + three.var(ddof=1)) / 12)


FACES = {"shape": "box", "lower": -2.0, "upper": 4.0, "outside_index": {"y_low": 1.0}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"transport.estimator": "next_event"}, 'estimator = "next_event"'),
        ({"domain": FACES}, "faces of the domain that reflect"),
    ],
)
def test_what_goes_with_one_point_alone_is_refused(changes, named, device):
    one = scene().with_overrides({"transport.points_per_flight": 2, **changes})
    text = f"transport.points_per_flight = 2 cannot be combined with {named}; take 1"
    for refuse in (lambda: simulate(one, photons=100, device=device), lambda: spadwarp.check(one)):
        with pytest.raises(ConfigError, match=text):
            refuse()
    assert points_per_flight(one.with_overrides({"transport.points_per_flight": "auto"})) == 1
    assert points_per_flight(scene()) == 2
    with pytest.raises(ConfigError, match="points_per_flight"):
        scene(transport={"points_per_flight": 4})
