"""Equation 7 over the spectrum of the laser and of the filter."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad

import spadwarp
from helpers.lidar import lidar
from reference import crlb
from spadwarp.analytic import pixel_maps
from spadwarp_kernels import analytic as kernels

pytestmark = pytest.mark.physics


def on_axis(scene, distance, **options):
    axis = np.array([[0.0, 0.0, 1.0]])
    wall = {"distance": [distance], "normal": -axis, "reflectance": [0.4]}
    return pixel_maps(scene, view=axis, **wall, device="cpu", **options)[0]


def test_signal_is_the_integral_of_equation_7():
    """Against scipy's adaptive quadrature of eq 7 times a Gaussian spectrum and a Gaussian filter."""
    scene = spadwarp.load_scene(
        "staircase_15m",
        {
            "medium": {"chlorophyll": 0.5, "preset": None, "extinction": None, "albedo": None},
            "laser.preset": None, "laser.wavelength_nm": 590.0, "laser.linewidth_nm": 30.0,
            "detector.filter_fwhm_nm": 25.0, "detector.filter_centre_nm": 580.0, "detector.filter_peak": 0.8,
            "analytic.form": "lu2024",
        },
    )  # fmt: skip
    four_ln2 = 4.0 * math.log(2.0)
    energy, pde, tangent = scene.laser.pulse_energy, scene.detector.pde, math.tan(scene.laser.half_angle)
    pitch = scene.camera.pixel_tangent * 2.0 * scene.camera.aperture_radius  # over the f-number

    def integrand(nm):
        spectrum = math.sqrt(four_ln2 / math.pi) / 30.0 * math.exp(-four_ln2 * ((nm - 590.0) / 30.0) ** 2)
        passed = 0.8 * math.exp(-four_ln2 * ((nm - 580.0) / 25.0) ** 2)
        extinction = spadwarp.water.water_optics(nm, chlorophyll=0.5).extinction
        return spectrum * passed * crlb.eq7(energy, nm * 1e-9, pde, 0.4, extinction, 14.0, pitch, 1.0, tangent)

    expected = quad(integrand, 530.0, 650.0, limit=400, points=np.arange(532.5, 650.0, 2.5))[0]
    maps = on_axis(scene, 14.0, gate=(1e-7, 2e-7))
    assert maps["signal"][0] == pytest.approx(expected, rel=3e-3)  # 32 lines
    one_line = on_axis(scene.with_overrides({"laser.linewidth_nm": 0.0}), 14.0, gate=(1e-7, 2e-7))
    assert maps["signal"][0] > 1.5 * one_line["signal"][0]  # red is absorbed: the line at 590 nm is no mean of it


def test_arrival_is_the_mean_of_the_group_delays():
    scene = spadwarp.load_scene("plane_5m", {"medium": {"chlorophyll": 0.1}, "laser.linewidth_nm": 40.0})
    lines = spadwarp.scene.water_lines(scene)
    path = np.hypot(5.0, np.linalg.norm(scene.beam.position)) + 5.0
    weights = [share * math.exp(-water.extinction * path) for share, water in lines]
    mean = np.average([path / water.pulse_speed for _, water in lines], weights=weights)
    assert on_axis(scene, 5.0)["arrival"][0] == pytest.approx(mean, rel=1e-7)


def test_filter_scales_signal_and_backscatter_alike():
    scene = spadwarp.load_scene("plane_5m")
    filtered = on_axis(scene.with_overrides({"detector.filter_fwhm_nm": 5.0, "detector.filter_peak": 0.6}), 5.0)
    plain = on_axis(scene, 5.0)
    for name in ("signal", "backscatter"):
        assert filtered[name] == pytest.approx(0.6 * plain[name], rel=1e-12)


def test_lines_add_up_in_the_kernels():
    """Backscatter of two lines is the sum of both; where nothing else varies, so is α, and F that of their rates."""
    one, other = (2.0, 0.3, 0.2), (3.0, 0.5, 0.1)
    view = wp.array([[0.0, 0.0, 1.0]], dtype=wp.vec3d, device="cpu")
    distance = wp.array([4.0], dtype=wp.float64, device="cpu")
    phase = wp.array(np.full(64, 1.0 / (4.0 * np.pi)), dtype=wp.float64, device="cpu")

    def total(*lines):
        common = lidar(source=1)
        array = wp.array(lines, dtype=wp.vec3d, device="cpu")
        return kernels.single_scatter_table(common, phase, view, distance, lines=array)[2].numpy()[0]

    assert total(one, other) == pytest.approx(total(one) + total(other), rel=1e-13)
    own = lidar(source=1, photons=2.0, extinction=0.3, scattering=0.2)
    assert kernels.single_scatter_table(own, phase, view, distance)[2].numpy()[0] == total(one)
