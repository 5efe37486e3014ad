"""Spectrum of the laser and filter of the detector."""

import math
from dataclasses import replace

import numpy as np
import pytest

import spadwarp
from spadwarp.scene import filter_transmission, spectral_lines, water_lines
from spadwarp.values import ConfigError, FileError

pytestmark = pytest.mark.fast


def plane(**fields):
    return spadwarp.load_scene("plane_5m", {name.replace("__", "."): value for name, value in fields.items()})


def share(scene):
    return math.fsum(line.share for line in spectral_lines(scene.laser, scene.detector))


def test_without_spectrum_and_filter_nothing_changes():
    scene = plane()
    assert spectral_lines(scene.laser, scene.detector) == ((532.0, 1.0),)
    assert scene.detections_per_photon == scene.detector.pde


@pytest.mark.parametrize(
    "linewidth, fwhm, offset", [(10.0, 5.0, 4.0), (1.0, 10.0, 3.0), (30.0, 2.0, 8.0), (0.1, 3.0, 0)]
)
def test_gaussian_light_through_a_gaussian_filter(linewidth, fwhm, offset):
    """Closed form: the product of two Gaussians is a Gaussian; photons of a pulse are proportional to λ."""
    centre = {"detector__filter_centre_nm": 532.0 + offset, "detector__filter_peak": 0.9}
    scene = plane(laser__linewidth_nm=linewidth, detector__filter_fwhm_nm=fwhm, **centre)
    sum2 = linewidth**2 + fwhm**2
    passed = 0.9 * fwhm / math.sqrt(sum2) * math.exp(-4.0 * math.log(2.0) * offset**2 / sum2)
    mean = 532.0 + offset * linewidth**2 / sum2
    assert share(scene) == pytest.approx(passed * mean / 532.0, rel=1e-4)
    shares, wavelengths = np.array([(x.share, x.wavelength_nm) for x in spectral_lines(scene.laser, scene.detector)]).T
    centre = np.average(wavelengths, weights=shares)
    assert centre == pytest.approx(mean, abs=2e-3 * linewidth)
    # 32 lines lose the variance within one of them.
    expected = linewidth * fwhm / math.sqrt(sum2) / (2.0 * math.sqrt(2.0 * math.log(2.0)))
    assert math.sqrt(np.average((wavelengths - centre) ** 2, weights=shares)) == pytest.approx(expected, rel=0.02)


def test_one_line_through_a_filter():
    scene = plane(detector__filter_fwhm_nm=10.0, detector__filter_centre_nm=537.0, detector__filter_peak=0.8)
    assert scene.detections_per_photon == pytest.approx(0.4 * scene.detector.pde)  # half the height at FWHM/2
    assert filter_transmission(scene.laser, scene.detector, [527.0, 537.0, 547.0]) == pytest.approx([0.05, 0.8, 0.05])


def test_tables(tmp_path):
    """A flat spectrum from 500 to 560 nm through a filter that is 0.5 from 520 to 530 nm and 0 elsewhere."""
    (tmp_path / "led.csv").write_text("wavelength_nm,power\n500,3\n560,3\n")
    (tmp_path / "filter.csv").write_text("# mine\nwavelength_nm,transmission\n519.999,0\n520,0.5\n530,0.5\n530.001,0\n")
    scene = plane(laser__spectrum=str(tmp_path / "led.csv"), detector__filter_table=str(tmp_path / "filter.csv"))
    assert share(scene) == pytest.approx(0.5 * 10.0 / 60.0 * 525.0 / 532.0, rel=1e-3)
    assert {path.name for path in scene.files} >= {"led.csv", "filter.csv"}


def test_detections_pass_the_filter():
    """`detect` takes the light times the filter's transmission; dark counts and `ambient_rate` stay."""
    scene = plane(camera__width=4, camera__height=4)
    result = spadwarp.simulate(scene, photons=20_000, seed=1, device="cpu")
    filtered = replace(result, scene=scene.with_overrides({"detector.filter_fwhm_nm": 3, "detector.filter_peak": 0.7}))
    dark = scene.detector.noise_rate * scene.gate.bin_width * result.histogram.size
    open_light, light = (
        spadwarp.detect(one, pulses=10, seed=1, device="cpu").expected.sum() - dark for one in (result, filtered)
    )
    assert light == pytest.approx(0.7 * open_light, rel=1e-3)
    assert filtered.detections == pytest.approx(0.7 * result.detections)


def test_lines_in_the_water():
    scene = plane(medium={"chlorophyll": 0.5}, laser__linewidth_nm=20.0)
    lines = spectral_lines(scene.laser, scene.detector)
    optics = [spadwarp.water.water_optics(line.wavelength_nm, chlorophyll=0.5) for line in lines]
    assert [water.extinction for _, water in water_lines(scene)] == pytest.approx([x.extinction for x in optics])
    assert len(lines) == 32
    assert len(water_lines(plane(laser__linewidth_nm=20.0))) == 1  # coefficients given as numbers hold for all


@pytest.mark.parametrize(
    "text, error, message",
    [
        (None, FileError, r"led\.csv"),
        ("500,1\n", ConfigError, "two rows"),
        ("500,1\n490,1\n", ConfigError, "rising"),
        ("500,0\n510,0\n", ConfigError, "no power above 0"),
        ("380,1\n560,1\n", ConfigError, "the spectrum reaches beyond"),
    ],
)
def test_refused_tables(tmp_path, text, error, message):
    scene = plane(laser__spectrum=str(tmp_path / "led.csv"), medium={"chlorophyll": 0.5})
    if text is not None:
        (tmp_path / "led.csv").write_text(text)
    with pytest.raises(error, match=message):
        water_lines(scene)


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"detector__filter_fwhm_nm": 10.0, "detector__filter_centre_nm": 547.3}, ["passes 0.152 % of the laser's"]),
        (
            {"laser__linewidth_nm": 60.0, "medium": {"chlorophyll": 0.5, "temperature": 20.0}},
            ["over the spectrum the water leaves", "dispersion spreads the target's light"],
        ),
        ({"laser__linewidth_nm": 80.0, "medium": {"chlorophyll": 0.5}}, ["the analytic simulator refuses"]),
        ({"detector__filter_fwhm_nm": 10.0}, []),
    ],
)
def test_checks(fields, words):
    texts = [str(message) for message in spadwarp.check(plane(**fields))]
    assert all(any(word in text for text in texts) for word in words)
    assert words or not any("spectrum" in text or "filter" in text for text in texts)
