"""Phase functions of scenes: their fields, their files, and Petzold's average particle."""

import math
from pathlib import Path

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from reference import fournier_forand
from reference.single_scatter import henyey_greenstein
from spadwarp.scene import Medium
from spadwarp.scene.medium import PHASE_TABLES
from spadwarp.values import ConfigError, FileError

WATER = {"extinction": 0.3, "albedo": 0.8}


def law_of(**fields):
    return spadwarp.scene.phase_function(Medium(**WATER, **fields))


def test_each_phase_function_is_the_one_of_its_fields():
    hg = law_of(anisotropy=0.7)
    two = law_of(phase_function="two_term_henyey_greenstein", g1=0.9, g2=-0.2, alpha=0.75)
    ff = law_of(phase_function="fournier_forand")
    angle = np.radians([5.0, 90.0, 180.0])
    np.testing.assert_allclose(hg.density(angle), henyey_greenstein(np.cos(angle), 0.7), rtol=1e-12)
    mixture = 0.75 * henyey_greenstein(np.cos(angle), 0.9) + 0.25 * henyey_greenstein(np.cos(angle), -0.2)
    np.testing.assert_allclose(two.density(angle), mixture, rtol=1e-12)
    assert (hg.mean_cosine, two.mean_cosine) == pytest.approx((0.7, 0.75 * 0.9 - 0.25 * 0.2), rel=1e-9)
    assert ff.backscatter_fraction == pytest.approx(0.0183, abs=5e-5)
    assert ff.parameters == {"particle_index": 1.1, "junge_slope": 3.5835}
    expected = fournier_forand.cumulative(2 * np.sin(np.radians([0.1, 60.0]) / 2) ** 2, 1.10, 3.5835)
    assert [ff.fraction_below(math.radians(angle)) for angle in (0.1, 60.0)] == pytest.approx(expected, rel=1e-9)
    assert ff.fraction_below(math.pi) == pytest.approx(1.0, rel=1e-9)
    assert ff.fraction_below(math.pi / 2) + ff.backscatter_fraction == pytest.approx(1.0, rel=1e-9)


def test_petzolds_average_particle_has_its_published_moments():
    """Backscatter fraction 0.0183, mean cosine 0.924 (Mobley et al. 1993), values as published but for their sum."""
    law = law_of(phase_function="tabulated", phase_table="petzold-average-particle")
    assert law.backscatter_fraction == pytest.approx(0.0183, abs=1e-4)
    assert law.mean_cosine == pytest.approx(0.924, abs=5e-4)
    # Mobley integrates from point to point by other means: one per cent.
    published = {0.1: 1767.0, 1.0: 71.61, 10.0: 1.153, 90.0: 4.292e-3, 140.0: 2.329e-3, 180.0: 3.154e-3}
    for angle, value in published.items():
        assert float(law.density(math.radians(angle))) == pytest.approx(value, rel=0.01)
    # Below 0.1° the power law goes on: Mobley's exponent there is -1.346.
    ratio = law.density(math.radians(0.01)) / law.density(math.radians(0.1))
    assert math.log10(ratio) == pytest.approx(1.346, abs=0.01)


def about(one, field):
    return [message for message in spadwarp.check(one) if message.field == field]


def test_a_check_reads_the_table_and_says_what_it_leaves_out(tmp_path):
    path = tmp_path / "vsf.csv"
    one = scene(medium={"phase_function": "tabulated", "phase_table": str(path)})
    with pytest.raises(FileError):
        spadwarp.check(one)
    path.write_text("5,4.3\n10,1.15\n90,0.0043\n180,0.0031\n")
    (note,) = about(one, "medium.phase_table")
    assert note.text.startswith("begins at 5°: ") and note.values["continued"] > 0.5
    petzold = one.with_overrides(medium={"phase_table": "petzold-average-particle"})
    assert not about(petzold, "medium.phase_table")


def test_a_check_warns_of_a_peak_narrower_than_the_near_axis_rule():
    one = scene(medium={"phase_function": "fournier_forand"}, transport={"axis_threshold": 0.9998})
    within = float(fournier_forand.cumulative(1 - 0.9998, 1.10, 3.5835))
    found = [message.values for message in about(one, "transport.axis_threshold") if "within" in message.values]
    assert [values["within"] for values in found] == pytest.approx([within])
    broad = {"phase_function": "two_term_henyey_greenstein", "g1": 0.8, "g2": 0.0, "alpha": 0.9}
    for other in (one.with_overrides(transport={"axis_threshold": 1.0}), one.with_overrides(medium=broad)):
        assert not [message for message in spadwarp.check(other) if "within" in message.values]


@pytest.mark.parametrize("name", PHASE_TABLES)
def test_shipped_tables_are_sourced_and_offered(name):
    table = Path(spadwarp.water.__file__).parent / "tables" / PHASE_TABLES[name]
    assert "tabulated by" in table.read_text().partition("angle_deg")[0]
    media = [preset.values for preset in spadwarp.scene.presets("medium").values()]
    laws = [law for medium in media for law in (medium, *medium.get("constituents", ()))]
    assert any(law.get("phase_table") == name for law in laws)
    assert law_of(phase_function="tabulated", phase_table=name).mean_cosine > 0


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("0,1\n90,nan\n", "medium.phase_table: .*line 2: '90,nan' is not angle_deg,value in finite numbers"),
        ("0,1\n90\n", "line 2: '90' is not angle_deg,value in finite numbers"),
        ("0,1\n", "two or more"),
        ("90,1\n0,1\n", "ascending"),
        ("0,1\n190,1\n", r"line 2: angle_deg = 190 is outside \[0, 180\]"),
        ("0,1\n90,-1\n", r"line 2: value = -1 is outside \[0, 1e30\]"),
        ("0,1\n90,inf\n", "line 2: value = inf is outside"),
        ("0,1\n" + "9" * 140_000 + ",1\n", "line 2: field larger than field limit"),
    ],
)
def test_a_bad_table_is_named(text, error, tmp_path):
    path = tmp_path / "vsf.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=error) as caught:
        law_of(phase_function="tabulated", phase_table=str(path))
    assert str(path) in str(caught.value)


def test_overriding_the_phase_function_drops_the_fields_of_the_old_one():
    one = scene(medium={"preset": "petzold-nuc-2040-tabulated", "albedo": None, "extinction": None})
    assert one.medium.phase_table == "petzold-average-particle"
    other = one.with_overrides(["medium.phase_function=fournier_forand"])
    assert (other.medium.phase_function, other.medium.phase_table) == ("fournier_forand", None)
    assert spadwarp.Scene.from_dict(other.to_dict()) == other
