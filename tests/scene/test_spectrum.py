"""Spectrum of the laser and filter of the detector."""

import math
from dataclasses import replace

import pytest

import spadwarp
from spadwarp.scene import detection_efficiency, filter_transmission, spectral_lines, water_lines
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
    scene = plane(
        laser__linewidth_nm=linewidth,
        detector__filter_fwhm_nm=fwhm,
        detector__filter_centre_nm=532.0 + offset,
        detector__filter_peak=0.9,
    )
    sum2 = linewidth**2 + fwhm**2
    passed = 0.9 * fwhm / math.sqrt(sum2) * math.exp(-4.0 * math.log(2.0) * offset**2 / sum2)
    mean = 532.0 + offset * linewidth**2 / sum2
    assert share(scene) == pytest.approx(passed * mean / 532.0, rel=1e-4)
    lines = spectral_lines(scene.laser, scene.detector)
    centre = math.fsum(line.share * line.wavelength_nm for line in lines) / share(scene)
    width2 = math.fsum(line.share * (line.wavelength_nm - centre) ** 2 for line in lines) / share(scene)
    assert centre == pytest.approx(mean, abs=2e-3 * linewidth)
    # 32 lines lose the variance within one of them.
    expected = linewidth * fwhm / math.sqrt(sum2) / (2.0 * math.sqrt(2.0 * math.log(2.0)))
    assert math.sqrt(width2) == pytest.approx(expected, rel=0.02)


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
    assert spadwarp.scene.Scene.from_toml(scene.to_toml()) == scene
    assert {path.name for path in scene.files} >= {"led.csv", "filter.csv"}


def test_detections_pass_the_filter():
    """`detect` takes the light times the filter's transmission; dark counts and `ambient_rate` stay."""
    scene = plane(camera__width=4, camera__height=4)
    result = spadwarp.simulate(scene, photons=20_000, seed=1, device="cpu")
    filtered = replace(result, scene=scene.with_overrides({"detector.filter_fwhm_nm": 3, "detector.filter_peak": 0.7}))
    dark = scene.detector.noise_rate * scene.gate.bin_width
    open_light = spadwarp.detect(result, pulses=10, seed=1, device="cpu").expected.sum() - dark * result.histogram.size
    light = spadwarp.detect(filtered, pulses=10, seed=1, device="cpu").expected.sum() - dark * result.histogram.size
    assert light == pytest.approx(0.7 * open_light, rel=1e-3)
    assert filtered.detections == pytest.approx(0.7 * result.detections)


def test_lines_in_the_water():
    scene = plane(medium={"chlorophyll": 0.5}, laser__linewidth_nm=20.0)
    lines = water_lines(scene)
    assert len(lines) == 32
    optics = [
        spadwarp.water.water_optics(line.wavelength_nm, chlorophyll=0.5)
        for line in spectral_lines(scene.laser, scene.detector)
    ]
    assert [line.extinction for line in lines] == pytest.approx([one.extinction for one in optics])
    assert len(water_lines(plane(laser__linewidth_nm=20.0))) == 1  # coefficients given as numbers hold for all


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"laser__linewidth_nm": 200.0}, "laser.linewidth_nm = 200.0 is outside"),
        ({"laser__spectrum": "led.txt"}, "is not the path of a .csv file"),
        ({"detector__filter_peak": 0.5}, "filter_peak = 0.5 needs filter_fwhm_nm"),
        ({"detector__filter_centre_nm": 532.0}, "filter_centre_nm = 532.0 needs filter_fwhm_nm"),
        ({"detector__filter_peak": 1.5, "detector__filter_fwhm_nm": 1.0}, "filter_peak = 1.5"),
    ],
)
def test_refused(fields, message):
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")):
        plane(**fields)


def test_refused_tables(tmp_path):
    table = tmp_path / "led.csv"
    scene = plane(laser__spectrum=str(table))
    with pytest.raises(FileError, match=r"led\.csv"):
        detection_efficiency(scene.laser, scene.detector)
    for text, message in (
        ("500,1\n", "two rows"),
        ("500,1\n490,1\n", "rising"),
        ("500,0\n510,0\n", "no power above 0"),
    ):
        table.write_text(text)
        with pytest.raises(ConfigError, match=message):
            detection_efficiency(scene.laser, scene.detector)
    table.write_text("380,1\n560,1\n")
    with pytest.raises(ConfigError, match="the spectrum reaches beyond"):
        water_lines(plane(laser__spectrum=str(table), medium={"chlorophyll": 0.5}))


def test_checks():
    def texts(**fields):
        return [str(message) for message in spadwarp.check(plane(**fields))]

    assert any("passes 0.152 % of the laser's light" in text for text in texts(
        detector__filter_fwhm_nm=10.0, detector__filter_centre_nm=547.3))  # fmt: skip
    broad = texts(laser__linewidth_nm=60.0, medium={"chlorophyll": 0.5, "temperature": 20.0})
    assert any("over the spectrum the water leaves" in text for text in broad)
    assert any("dispersion spreads the target's light" in text for text in broad)
    beyond = texts(laser__linewidth_nm=80.0, medium={"chlorophyll": 0.5})
    assert any("the analytic simulator refuses" in text for text in beyond)
    assert not any("spectrum" in text or "filter" in text for text in texts(detector__filter_fwhm_nm=10.0))
