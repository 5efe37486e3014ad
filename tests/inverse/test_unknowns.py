"""Names of unknowns, and counts that fit a scene."""

import numpy as np
import pytest

import spadwarp
from helpers.inverse import plate
from spadwarp.inverse import read_exposure, read_unknowns
from spadwarp.inverse.unknowns import moved, scene_value, with_values


def test_short_names_stand_for_fields():
    found = read_unknowns(plate(), "absorption, reflectance,depth:pixel,background")
    names = ["medium.absorption", "targets[0].reflectance", "depth", "detector.ambient_rate"]
    expected = zip(names, (False, False, True, False), ("1/m", "", "m", "1/s"), strict=True)
    assert [(one.name, one.per_pixel, one.unit) for one in found] == list(expected)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("", "is not one of"),
        ([], "no name is given"),
        ("absorbtion", "did you mean 'absorption'"),
        ("depth,depth:pixel", "named twice"),
        ("absorption:pixel", "of the whole water"),
        ("depth:row", "':pixel'"),
        ("targets[3].reflectance", "has 1 target"),
    ],
)
def test_other_names_are_refused(names, words):
    with pytest.raises(spadwarp.SpadwarpError, match=f"unknown: .*{words}"):
        read_unknowns(plate(), names)


def test_concentrations_are_unknowns_by_the_names_of_constituents():
    parts = [{"name": "algae", "scattering": 0.5, "concentration": n} for n in (0.5, 0.0)]
    law = dict.fromkeys(("absorption", "scattering", "anisotropy"))
    one = plate({"medium": {**law, "constituents": [parts[0], {**parts[1], "name": "sand"}]}})
    (found,) = read_unknowns(one, "algae")
    assert found.name == "medium.constituents[0].concentration" and found.is_positive and found.is_light
    assert scene_value(one, found) == 0.5
    assert with_values(one, {found.name: 0.7}).medium.scattering == pytest.approx(0.35)
    for name, words in (("sand", "is 0"), ("scattering", "medium has constituents")):
        with pytest.raises(spadwarp.SpadwarpError, match=f"unknown: .*{words}"):
            read_unknowns(one, name)
    with pytest.raises(spadwarp.SpadwarpError, match="has 0 constituents"):
        read_unknowns(plate(), "medium.constituents[0].concentration")


def test_what_has_no_derivative_is_refused():
    for changes, name, words in (
        ({"medium.phase_function": "fournier_forand"}, "anisotropy", "henyey_greenstein"),
        ({"targets": []}, "depth", "no targets"),
    ):
        with pytest.raises(spadwarp.ConfigError, match=words):
            read_unknowns(plate(changes), name)


def test_values_go_into_the_scene():
    scene = with_values(plate(), {"medium.absorption": 0.5, "targets[0].reflectance": 0.1, "depth": 0.25})
    assert (scene.medium.absorption, scene.medium.scattering) == (0.5, 0.7)
    assert scene.targets[0].reflectance == 0.1 and scene.targets[0].translation == (0.0, 0.0, 1.75)
    turned = plate({"camera.rotation_deg": [0.0, 90.0, 0.0]})
    np.testing.assert_allclose(moved(turned, 1.0).targets[0].translation, (1.0, 0.0, 1.5), atol=1e-12)


def test_counts_have_to_fit_the_scene(tmp_path):
    scene = plate()
    counts = np.zeros((2, 8, 8, 160), np.int32)
    counts[:, 3, 3, 5] = 4
    exposure = read_exposure(counts, scene, pulses=10)
    assert exposure.pulses == 20 and exposure.counts.sum() == 8
    assert exposure.left()[27, 5] == 20 and exposure.left()[27, 6] == 12
    np.save(tmp_path / "counts.npy", counts[0])
    stored = read_exposure(tmp_path / "counts.npy", scene, pulses=10, gate_start=6e-9)
    assert stored.counts.sum() == 4 and stored.window == (6e-9, 160)
    for wrong, words in (
        (counts[:, :4], r"an image of \(4, 8\)"),
        (counts + 0.5, "rates"),
        (counts - 1, "outside"),
        (counts[0, 0], r"\[H, W, T\]"),
    ):
        with pytest.raises(spadwarp.ArgumentError, match=words):
            read_exposure(wrong, scene)
    with pytest.raises(spadwarp.ArgumentError, match="110"):
        read_exposure(tmp_path / "counts.npy", scene, gate_start=0.0, bin_width=55e-12)
