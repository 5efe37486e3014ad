"""Runs at several wavelengths with the same photons, and their sum over a spectrum."""

import dataclasses
import math

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from helpers.statistics_of_samples import equal_means_p
from spadwarp.scene import spectral_lines
from spadwarp.transport import simulate_spectrum
from spadwarp.values import ArgumentError, ConfigError

SEA = {"extinction": None, "albedo": None, "group_index": None, "chlorophyll": 0.5}


def broad(**laser):
    """A laser of 540 nm, 60 nm wide, behind a filter, in water that follows the wavelength."""
    laser = {"wavelength_nm": 540.0, "linewidth_nm": 60.0, **laser}
    return scene(medium=SEA, laser=laser, detector={"filter_fwhm_nm": 40.0})


def test_a_line_far_from_the_others_is_its_own_run_to_the_bit(device):
    found = simulate_spectrum(broad(), [650.0, 480.0], photons=5_000, device=device)
    assert tuple(found.results) == (480.0, 650.0)
    for wavelength, one in found.results.items():
        own = scene(medium=SEA, laser={"wavelength_nm": wavelength}, detector={"filter_fwhm_nm": 40.0})
        assert (spadwarp.simulate(own, photons=5_000, device=device).tallies == one.tallies).all()
        filtered = one.scene.detections_per_photon / one.scene.detector.pde
        assert filtered == pytest.approx(0.5 ** ((wavelength - 540.0) / 20.0) ** 2)


@pytest.mark.slow
def test_near_lines_share_photons_and_are_as_their_own_runs(device):
    """Of water whose absorption, scattering, molecules and group index differ, within a gate that moves with it."""
    gate = {"start_ns": 3.3, "bin_width_ps": 1111.0, "bins": 20}
    one = scene(medium=SEA, gate=gate, transport={"estimator": "guided"})
    lines, photons, seeds = [500.0, 515.0, 532.0, 545.0, 552.0], 20_000, range(16)
    own, shared = [], []
    for seed in seeds:
        runs = simulate_spectrum(one, lines, photons=photons, seed=seed, device=device).results
        shared.append([run.histogram.sum(axis=(0, 1)) for run in runs.values()])
        assert len({tuple(run.energy_balance.values()) for run in runs.values()}) == 1
        apart = (one.with_overrides({"laser.wavelength_nm": line}) for line in lines)
        apart = [spadwarp.simulate(each, photons=photons, seed=100 + seed, device=device) for each in apart]
        own.append([run.histogram.sum(axis=(0, 1)) for run in apart])
    own, shared = np.array(own), np.array(shared)
    for k in range(len(lines)):
        assert equal_means_p(shared[:, k], own[:, k], 0.5) > 1e-3
    # The delay of a line over that of the photons', in bins, is known better than the light of a bin.
    late = shared @ np.arange(20) / shared.sum(axis=-1) - own @ np.arange(20) / own.sum(axis=-1)
    assert (abs(late.mean(axis=0)) < 4.0 * late.std(axis=0, ddof=1) / math.sqrt(len(seeds))).all()


def test_the_sum_over_the_spectrum_is_that_of_its_lines(device):
    one = broad(linewidth_nm=4.0).with_overrides({"camera.polarisation": "analyser"})
    found = simulate_spectrum(one, photons=2_000, device=device)
    lines = spectral_lines(one.laser, one.detector)
    assert tuple(found.results) == tuple(line.wavelength_nm for line in lines) and len(lines) > 8
    expected = sum(line.share * found.results[line.wavelength_nm].histogram for line in lines)
    combined = found.combined()
    passed = combined.scene.detections_per_photon / one.detector.pde
    np.testing.assert_allclose(combined.histogram * passed, expected, rtol=1e-4, atol=1e-4 * expected.max())
    expected = sum(line.share * found.results[line.wavelength_nm].channels["cross"] for line in lines)
    np.testing.assert_allclose(combined.channels["cross"] * passed, expected, rtol=1e-4, atol=1e-4 * expected.max())
    flux = {"flux": [{"name": "a", "positions": [1.0]}], "transport.estimator": "next_event"}
    with pytest.raises(ConfigError, match="flux is not summed over the lines"):
        dataclasses.replace(found, scene=broad().with_overrides(flux)).combined()
    # In 4 nm water hardly changes, and what is left of the noise is shared.
    alone = spadwarp.simulate(broad(linewidth_nm=0.0), photons=2_000, device=device)
    assert combined.histogram.sum() == pytest.approx(alone.histogram.sum(), rel=5e-3)
    assert combined.batches == 0 and combined.scene == one


def test_lines_have_an_axis():
    pytest.importorskip("xarray")
    data = simulate_spectrum(broad(), [480.0, 500.0], photons=500, device="cpu").to_xarray()
    assert data["histogram"].dims[0] == "wavelength" and data["wavelength"].values.tolist() == [480.0, 500.0]
    assert (data["histogram"].sel(wavelength=480.0) != data["histogram"].sel(wavelength=500.0)).any()


@pytest.mark.slow
@pytest.mark.physics
def test_monte_carlo_over_the_spectrum_is_the_analytic_sum():
    """Eq 7: unscattered light of the target through a filter, of a laser over whose width the water changes much."""
    one = broad(wavelength_nm=600.0, linewidth_nm=30.0).with_overrides(
        {"detector.filter_fwhm_nm": 60.0, "camera.aperture_diameter": 0.02, "transport.estimator": "guided"}
    )
    found = simulate_spectrum(one, photons=20_000, device="cpu").combined()
    scale = one.laser.photons_per_pulse * one.detections_per_photon
    light = found.component("ballistic").sum(axis=-1) * scale
    expected = spadwarp.simulate_analytic(one, frames=0, device="cpu").signal
    narrow = spadwarp.simulate_analytic(one.with_overrides({"laser.linewidth_nm": 0.0}), frames=0, device="cpu").signal
    assert light.sum() == pytest.approx(expected.sum(), rel=0.01)
    assert abs(narrow.sum() * one.detections_per_photon / one.detector.pde / expected.sum() - 1.0) > 0.05


def test_the_file_has_an_axis_of_wavelength(tmp_path):
    found = simulate_spectrum(broad(wavelengths_nm=[500.0, 480.0]), photons=500, device="cpu")
    with h5py.File(found.save(tmp_path / "spectrum.h5")) as file:
        assert [scale[0].name for scale in file["histogram"].dims] == [
            f"/{name}" for name in ("wavelength", "component", "y", "x", "time")
        ]
        assert file["wavelength"][:].tolist() == [480.0, 500.0]
        for number, one in enumerate(found.results.values()):
            np.testing.assert_allclose(file["histogram"][number].sum(axis=0), one.histogram, rtol=1e-5, atol=1e-12)
            np.testing.assert_array_equal(file["depth"][number], one.depth().astype(np.float32))


def test_lines_done_before_an_interrupt_are_kept(monkeypatch):
    runs = iter([spadwarp.simulate])

    def run(scene, **options):
        if (one := next(runs, None)) is None:
            raise KeyboardInterrupt
        return one(scene, **options)

    monkeypatch.setattr("spadwarp.transport.spectrum.simulate", run)
    found = simulate_spectrum(broad(), [480.0, 650.0], photons=500, device="cpu")
    assert found.partial and tuple(found.results) == (480.0,) and found.results[480.0].photons == 500
    with pytest.raises(ConfigError, match="interrupted"):
        found.combined()
    with pytest.raises(KeyboardInterrupt):
        simulate_spectrum(broad(), [480.0, 650.0], photons=500, device="cpu")


def test_wavelengths_that_cannot_be_are_named():
    for given, text in (([], "0 given"), ([500.0, 500.0], "2 given"), ([0.0], "outside")):
        with pytest.raises(ArgumentError, match=text):
            simulate_spectrum(broad(), given, photons=500, device="cpu")
    with pytest.raises(ConfigError, match="1 wavelengths are not the 32 lines"):
        simulate_spectrum(broad(), [500.0], photons=500, device="cpu").combined()
