"""Presets: sourced, complete, and as published."""

import math
import re

import pytest

from helpers.pages import ROOT, text_of
from spadwarp.scene import Medium, phase_function, presets
from spadwarp.scene.medium import natural_laws
from spadwarp.water import pure_water_absorption

PUBLISHED = {
    **{"petzold-autec-8": 0.151, "petzold-haoce-11": 0.398, "petzold-nuc-2040": 2.190, "petzold-nuc-2240": 1.330},
    **{"uwoc-pure-sea": 0.056, "uwoc-clear": 0.149, "uwoc-coastal": 0.304, "uwoc-harbour": 2.17},
    **{"jerlov-IB-williamson": 0.177, "jerlov-5C-williamson": 1.376, "jerlov-I-solonenko": 0.0525},
    **{"jerlov-III-solonenko": 1.0926, "jerlov-9C-solonenko": 3.714, "lu2024": 0.035},
}
TANKS = {"1.7m-1.2": 1.2, "1.7m-4.4": 4.4, "1.7m-5.7": 5.7, "3m-7.5": 7.5}  # attenuation lengths


def test_every_preset_names_its_source():
    for name, preset in presets().items():
        assert name == f"{preset.section}.{preset.name}" and len(preset.source) > 30 and preset.values


@pytest.mark.parametrize("name", sorted(presets("medium")))
def test_every_medium_adds_up_and_all_but_the_papers_absorb_as_pure_water_does_or_more(name):
    medium = Medium(preset=name)
    assert medium.absorption + medium.scattering == pytest.approx(medium.extinction, rel=1e-12)
    if name != "lu2024":
        assert medium.albedo == pytest.approx(medium.scattering / medium.extinction, rel=1e-12)
        assert medium.absorption >= pure_water_absorption(530.0)


def test_extinctions_are_the_published_ones():
    for name, extinction in PUBLISHED.items():
        assert Medium(preset=name).extinction == pytest.approx(extinction, abs=1e-12), name
    for name, lengths in TANKS.items():
        distance = float(name.split("m-")[0])
        assert Medium(preset=f"maccarone-{name}").extinction * distance == pytest.approx(lengths, abs=0.01), name


def test_backscatter_of_natural_waters_is_the_published_one():
    """Mobley 1994, table 3.11, of 514 nm; the Ocean Optics Web Book's table of Fournier and Forand's law."""
    page, found = text_of(ROOT / "docs" / "phase_functions.md"), set()
    rows = re.findall(r"^\| `([\w-]+)`, ([^|]*) \| (0\.\d{4}) \| (0\.\d+)[^|]* \|", page, re.MULTILINE)
    for name, what, computed, published in rows:
        if name in presets("medium"):
            medium = Medium(preset=name)
        else:
            numbers = [float(number) for number in re.findall(r"\d\.\d+", what)]
            fields = dict(zip(("particle_index", "junge_slope"), numbers, strict=False))
            medium = Medium(absorption=0.1, scattering=0.1, phase_function=name, **fields)
        fraction = phase_function(medium).backscatter_fraction
        assert fraction == pytest.approx(float(computed), abs=5.1e-5), name
        assert fraction == pytest.approx(float(published), rel=0.07), name
        found.add(name)
    constituents = {name for name in presets("medium") if name.endswith("-constituents")}
    assert len(rows) == 8 and constituents == {name for name in found if name.endswith("-constituents")}
    for name in constituents:
        both = (Medium(preset=name), Medium(preset=name.removesuffix("-constituents")))
        sums = [(water.absorption, water.scattering, water.group_index) for water in both]
        assert sums[0] == pytest.approx(sums[1], rel=1e-12)
        # What `check` compares Henyey and Greenstein's law with, in the water without that ending.
        _, natural = natural_laws(both[1], both[1], 532.0)
        own = phase_function(both[0]).backscatter_fraction
        assert natural.backscatter_fraction == pytest.approx(own, rel=3e-3), name


def test_bubbles_are_those_of_geometric_optics():
    """Spheres far larger than the wavelength scatter twice their section; light that meets them flatly is reflected
    totally, up to a scattering angle of 180° - 2 arcsin(1/1.34); p(180°) after Churnside 2010."""
    bubbles = Medium(preset="petzold-autec-8-bubbles").constituents[2]
    small, large, ppm = 20e-6, 300e-6, 1e-6
    section = 3.0 * ppm * (1.0 / small - 1.0 / large) / math.log(large / small)
    assert bubbles.scattering == pytest.approx(section, rel=0.02)
    law = phase_function(Medium(preset="petzold-autec-8-bubbles")).constituents[2]
    critical = math.pi - 2.0 * math.asin(1.0 / 1.34)
    below, above = (float(law.density(critical + math.radians(side))) for side in (-5.0, 5.0))
    assert below > 2.5 * above
    assert float(law.density(math.pi)) * bubbles.scattering / ppm == pytest.approx(233.0, rel=0.15)
    assert law.backscatter_fraction == pytest.approx(0.0120, abs=5e-5)


@pytest.mark.parametrize(
    "series",
    [
        "jerlov-{IB,II,III,1C,3C,5C}-williamson",
        "jerlov-{I,IA,IB,II,III}-solonenko",
        "jerlov-{1C,3C,5C,7C,9C}-solonenko",
    ],
)
def test_water_gets_murkier_along_a_series(series):
    before, types, after = series.replace("}", "{").split("{")
    extinctions = [Medium(preset=f"{before}{one}{after}").extinction for one in types.split(",")]
    assert extinctions == sorted(extinctions)
