"""Reconstructed light: beside the tallies, of the same energy, nearer to the expectation."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import maximum_filter, uniform_filter

import spadwarp
import spadwarp_kernels as sk
from spadwarp.mesh import build_mesh
from spadwarp.result import COMPONENTS, Result


@pytest.fixture(scope="module")
def runs() -> tuple[Result, Result]:
    """The paper's staircase in few photons with its reconstruction, and other photons, 16 times as many."""
    scene = spadwarp.load_scene("configs/scenes/staircase_15m.toml").with_overrides(
        {"camera.width": 32, "camera.height": 24, "medium.extinction": 0.1}
    )
    few = spadwarp.simulate(scene, photons=50_000, seed=1, device="cpu")
    return spadwarp.reconstruct(few, device="cpu"), spadwarp.simulate(scene, photons=800_000, seed=2, device="cpu")


def test_energy_of_each_component_is_that_of_the_tallies(runs: tuple[Result, Result]) -> None:
    result, _ = runs
    for name in COMPONENTS:
        assert result.expected(name).sum() == pytest.approx(result.component(name).sum(), rel=1e-6)


def test_ballistic_light_has_no_floor_at_depths_of_other_pixels(runs: tuple[Result, Result]) -> None:
    few, other = (run.component("ballistic") > 0.0 for run in runs)
    dark = ~maximum_filter(few | other, (3, 3, 7))
    assert dark.mean() > 0.5
    assert (runs[0].expected("ballistic")[dark] > 0.0).mean() < 0.03  # sides of steps that a pixel's rays graze


def test_no_light_of_a_surface_comes_before_any_can_arrive(runs: tuple[Result, Result]) -> None:
    scene = runs[0].scene
    corners = build_mesh(scene).vertices[build_mesh(scene).faces].astype(np.float64)
    points = np.einsum("nc,fcx->nfx", np.random.default_rng(1).dirichlet((0.5, 0.5, 0.5), 1000), corners)
    path = np.linalg.norm(points, axis=-1) + np.linalg.norm(points - scene.laser.position, axis=-1)
    first = int((path.min() / scene.medium.pulse_speed - scene.gate.start) / scene.gate.bin_width)
    assert first > 10
    for name in ("ballistic", "forward_scattered"):
        light = runs[0].expected(name).sum(axis=(0, 1))
        assert not light[: first - 1].any() and light[first + 1] > 0.0


def test_no_light_is_negative_so_that_counts_can_be_drawn(runs: tuple[Result, Result]) -> None:
    """Of bright light beside empty bins, where sums in float32 end below 0."""
    near = {"camera.width": 16, "camera.height": 12, "targets[0].translation": [0.0, 0.0, 3.0]}
    bright = spadwarp.load_scene("configs/scenes/plane_5m.toml").with_overrides(near)
    for result in (
        runs[0],
        spadwarp.reconstruct(spadwarp.simulate(bright, photons=200_000, seed=0, device="cpu"), device="cpu"),
    ):
        assert result.reconstruction is not None and (result.reconstruction.histogram >= 0.0).all()
        spadwarp.crlb(result, pulses=2000, device="cpu")


def test_brightest_bins_have_a_seventh_of_the_squared_error(runs: tuple[Result, Result]) -> None:
    """As 7 times the photons; the other run has 1/16 of the variance, and its error is in both sums."""
    result, other = runs
    target = np.isfinite(result.truth.depth)
    peak = other.histogram.argmax(axis=-1)[..., None]
    at = {name: np.take_along_axis(cube, peak, axis=-1)[target] for name, cube in (
        ("traced", result.histogram), ("best", result.expected()), ("error", result.expected_error),
        ("other", other.histogram), ("its", other.standard_error),
    )}  # fmt: skip
    best, traced = at["best"] - at["other"], at["traced"] - at["other"]
    assert (best**2).sum() < 0.14 * (traced**2).sum()
    # Stated errors cover it in most pixels; 0.95 is meant.
    assert np.mean(np.abs(best) < 1.96 * np.hypot(at["error"], at["its"])) > 0.9


def test_file_keeps_the_reconstruction_and_a_sum_has_none(runs: tuple[Result, Result], tmp_path) -> None:
    result, _ = runs
    again = spadwarp.load(result.save(tmp_path / "result.h5"))
    assert again.reconstruction is not None and result.reconstruction is not None
    for name, values in vars(result.reconstruction).items():
        assert np.array_equal(values, getattr(again.reconstruction, name))
    assert spadwarp.merge([result]).reconstruction is None


def test_same_bits_again(runs: tuple[Result, Result]) -> None:
    result, _ = runs
    again = spadwarp.reconstruct(replace(result, reconstruction=None), device="cpu")
    assert np.array_equal(result.expected(), again.expected())
    assert np.array_equal(result.expected_error, again.expected_error)


@pytest.mark.parametrize("radius", [(0, 0), (0, 2), (3, 0), (2, 4), (9, 40)])
def test_window_sums_are_those_of_scipy(radius: tuple[int, int]) -> None:
    values = np.random.default_rng(3).random((6, 70, 11, 4), np.float32)
    values[:, 20] *= 1e8  # beside which sums in float32 would lose the rest
    zeros = [wp.zeros(values.shape[:3], dtype=wp.vec4, device="cpu") for _ in range(2)]
    arrays = [wp.array(values, dtype=wp.vec4, device="cpu"), *zeros]
    sk.window_sums(arrays[0], radius, arrays[1], arrays[2])
    size = (2 * radius[0] + 1, 2 * radius[0] + 1, 2 * radius[1] + 1, 1)
    expected = uniform_filter(values.astype(np.float64), size, mode="constant") * np.prod(size)
    np.testing.assert_allclose(arrays[2].numpy(), expected, rtol=2e-7, atol=2e-5)
