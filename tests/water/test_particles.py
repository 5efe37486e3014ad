"""Particles: Mie's theory against published values, Kopelevich's two components."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.cli import run
from spadwarp.values import ArgumentError
from spadwarp.water import (
    kopelevich_particles,
    log_normal,
    mie_particles,
    mixture,
    power_law,
    pure_water_absorption,
    pure_water_scattering,
    refractive_index,
    save_phase_table,
    single_size,
)

NM = 532.0
IN_WATER = NM * 1e-9 / refractive_index(NM)


def sphere(parameter, index):
    """One kind of sphere of a size parameter; and N·πD²/4 [1/m] at 1 ppm, which is 1.5e-6/D."""
    diameter = parameter * IN_WATER / math.pi
    return mie_particles(single_size(diameter), NM, index=index, concentration=1.0), 1.5e-6 / diameter


@pytest.mark.parametrize(
    "index, parameter, extinction, scattering, cosine",
    [
        (1.33 + 1e-5j, 1.0, 0.093952, 0.093924, 0.184517),  # Wiscombe 1979, NCAR/TN-140, test cases
        (1.33 + 1e-5j, 100.0, 2.101321, 2.096594, 0.868959),
        (1.5 + 1.0j, 100.0, 2.097502, 1.283697, 0.850252),
        (0.75 + 0.0j, 10.0, 2.232265, 2.232265, 0.896473),
        (1.55 + 0.0j, 5.21282, 3.10543, 3.10543, 0.63314),  # Bohren & Huffman 1983, appendix A
    ],
)
def test_efficiencies_that_were_published(index, parameter, extinction, scattering, cosine):
    particles, section = sphere(parameter, index)
    assert particles.extinction / section == pytest.approx(extinction, rel=1e-5)
    assert particles.scattering / section == pytest.approx(scattering, rel=1e-5)
    assert particles.mean_cosine == pytest.approx(cosine, abs=2e-3)
    if index == 1.55:  # Q_back = 4·Q_sca·π·p(180°)
        at_180 = particles.density[-1] * 4.0 * math.pi * particles.scattering / section
        assert at_180 == pytest.approx(2.92534, rel=1e-3)


def test_small_spheres_scatter_as_rayleigh():
    """Q = 8/3·x⁴·|(m² − 1)/(m² + 2)|², p = 3(1 + cos²θ)/16π."""
    particles, section = sphere(0.01, 1.2)
    m2 = 1.2**2
    assert particles.scattering / section == pytest.approx(8.0 / 3.0 * 1e-8 * ((m2 - 1) / (m2 + 2)) ** 2, rel=1e-3)
    cosine = np.cos(np.radians(particles.angles_deg))
    assert particles.density == pytest.approx(3.0 * (1.0 + cosine**2) / (16.0 * math.pi), rel=1e-3)
    assert particles.backscatter_fraction == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("index", [1.10, 1.15])
def test_backscatter_of_a_power_law(index):
    """Twardowski et al., J. Geophys. Res. 106, 14129 (2001), their fit to Mie's theory: n = 1 + B^(0.5377 + 0.4867·γ²)·
    (1.4676 + 2.2950·γ² + 2.3113·γ⁴), γ = ξ − 3, B the part scattered backward."""
    sizes = power_law(4.0, smallest=0.02e-6, largest=20e-6, sizes=30)
    particles = mie_particles(sizes, NM, index=index, concentration=1.0)
    fit = ((index - 1.0) / (1.4676 + 2.2950 + 2.3113)) ** (1.0 / (0.5377 + 0.4867))
    assert particles.backscatter_fraction == pytest.approx(fit, rel=0.15)


def test_kopelevich():
    """b at 550 nm of 1 ppm; the published parts scattered backward are 0.039 and 0.00064 (Haltrin 1999). The volume
    scattering functions integrate to 1.34 and 0.312 1/m, by a rule of their own."""
    small, large = kopelevich_particles(550.0, small=1.0, large=0.0), kopelevich_particles(550.0, small=0.0, large=1.0)
    assert (small.scattering, large.scattering) == (1.34, 0.312)
    assert small.backscatter_fraction == pytest.approx(0.039, rel=0.05)
    assert large.backscatter_fraction == pytest.approx(0.00064, rel=0.1)
    blue = kopelevich_particles(450.0, small=0.1, large=0.2)
    expected = 0.134 * (550.0 / 450.0) ** 1.7 + 0.0624 * (550.0 / 450.0) ** 0.3
    assert blue.scattering == pytest.approx(expected)
    angles, *columns = spadwarp.water.seawater.table_columns("kopelevich_particles")
    theta = np.radians(np.linspace(0.0, 180.0, 100_001))
    for values, expected in zip(columns, (1.34, 0.312), strict=True):
        curve = np.exp(np.interp(np.degrees(theta), angles, np.log(values)))
        assert 2.0 * math.pi * np.trapezoid(curve * np.sin(theta), theta) == pytest.approx(expected, rel=0.05)


def test_mixture_adds_the_water():
    parts = [kopelevich_particles(NM, small=0.1, large=0.0), kopelevich_particles(NM, small=0.0, large=0.3)]
    both = mixture(parts)
    own = pure_water_scattering(NM)
    assert both.absorption == pure_water_absorption(NM)
    assert both.scattering == pytest.approx(sum(part.scattering for part in parts) + own)
    backward = sum(part.scattering * part.backscatter_fraction for part in parts) + 0.5 * own
    assert both.backscatter_fraction == pytest.approx(backward / both.scattering, rel=2e-3)


def test_concentration_is_volume():
    """Twice the volume scatters twice; the mean volume of log-normal spheres is π/6·D³·exp(4.5·ln²σ)."""
    sizes = log_normal(1e-6, deviation=1.5, sizes=400)
    assert sizes.volume == pytest.approx(math.pi / 6.0 * 1e-18 * math.exp(4.5 * math.log(1.5) ** 2), rel=1e-2)
    few = log_normal(1e-6, deviation=1.2, sizes=15)
    once, twice = (mie_particles(few, NM, index=1.1, concentration=ppm).scattering for ppm in (1.0, 2.0))
    assert twice == pytest.approx(2.0 * once)


def test_command_makes_a_table_for_a_scene(tmp_path):
    path = tmp_path / "coast.csv"
    outcome = run("water", "532", "--particles", "small=0.05,large=0.2", "--out", path)
    assert "absorption = 0.04444" in outcome.output
    table = {"phase_function": "tabulated", "phase_table": str(path)}
    law = spadwarp.scene.phase_function(spadwarp.scene.Medium(extinction=0.3, albedo=0.8, **table))
    optics = mixture([kopelevich_particles(532.0, small=0.05, large=0.2)])
    assert law.mean_cosine == pytest.approx(optics.mean_cosine, abs=1e-4)
    assert law.backscatter_fraction == pytest.approx(optics.backscatter_fraction, rel=1e-3)
    assert save_phase_table(optics, tmp_path / "again.csv").read_text() == path.read_text()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ("concentration=1", "give small and large, or index"),
        ("small=1,index=1.1", "give small and large, or index"),
        ("small=1,slope=4", "slope belongs to index"),
        ("index=1.1", "concentration is missing"),
        ("index=1.1,concentration=1", "slope, median or diameter"),
        ("index=1.1,concentration=1,slope=4", "smallest is missing"),
        ("index=1.1,concentration=1,diameter=3 s", "is a time; a length is needed"),
        ("indx=1.1", "did you mean 'index'?"),
    ],
)
def test_the_command_refuses(arguments, words):
    assert words in " ".join(run("water", "532", "--particles", arguments, code=2).output.split())


def test_refused():
    assert "needs --particles" in run("water", "532", "--out", "a.csv", code=2).output
    with pytest.raises(ArgumentError, match=r"index.imag = -0.1"):
        mie_particles(single_size(1e-6), NM, index=1.1 - 0.1j, concentration=1.0)
    with pytest.raises(ArgumentError, match="no particles"):
        kopelevich_particles(NM, small=0.0, large=0.0)
    with pytest.raises(ArgumentError, match="one wavelength"):
        mixture([kopelevich_particles(at, small=1.0, large=0.0) for at in (NM, 500.0)])
