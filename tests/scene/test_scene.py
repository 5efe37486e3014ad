"""Scenes: media, presets and overrides win in the promised order; every number has a range."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.minimal_scene import problems, scene
from spadwarp.dataset.recipe import Recipe
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.scene import Medium, Scene, parse_override, presets
from spadwarp.scene.medium import Constituent
from spadwarp.scene.sections import interval_of, parts_of, table_of
from spadwarp.values import SPEED_OF_LIGHT, ConfigError

coefficients = st.floats(1e-6, 1e3)


@given(a=coefficients, b=coefficients)
def test_every_pair_of_coefficients_gives_the_same_medium(a, b):
    c = a + b
    truth = {"absorption": a, "scattering": b, "extinction": c, "albedo": b / c}
    names = list(truth)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            medium = Medium(**{first: truth[first], second: truth[second]})
            # A difference of two coefficients keeps the absolute accuracy of the larger.
            for name, value in truth.items():
                scale = max(1.0, c / min(a, b)) if name in ("absorption", "scattering", "extinction") else c / a
                assert getattr(medium, name) == pytest.approx(value, rel=1e-14 * scale)
            assert medium.given == (first, second)


def test_the_papers_albedo_goes_with_extinction_and_reads_as_its_mean():
    medium = Medium(extinction=0.2, albedo="lu2024")
    assert medium.albedo == "lu2024"
    assert medium.scattering == pytest.approx(0.2 * 0.97 / 2)
    assert medium.absorption + medium.scattering == pytest.approx(0.2)
    paper = scene(medium={"preset": "lu2024"})
    assert paper.with_overrides(["medium.extinction=0.9"]).medium.albedo == "lu2024"
    (text,) = problems({"medium": {"preset": "lu2024"}}, {"medium.absorption": 0.1})
    assert text.endswith("; given: absorption, extinction, albedo")


@pytest.mark.parametrize("base", [{"preset": "uwoc-harbour"}, {"absorption": 0.295, "scattering": 1.875}])
def test_overriding_one_coefficient_keeps_its_partner_and_overriding_two_replaces_both(base):
    one, before = scene(medium=base), Medium(**base)
    pairs = [("extinction", "albedo"), ("absorption", "scattering")]
    for changed, kept in [*pairs, *(pair[::-1] for pair in pairs)]:
        after = one.with_overrides({f"medium.{changed}": 0.5}).medium
        assert (getattr(after, changed), getattr(after, kept)) == (0.5, getattr(before, kept))
        assert set(after.given) == {changed, kept}
    both = one.with_overrides(["medium.extinction=0.9", "medium.albedo=0.5"]).medium
    assert (both.extinction, both.albedo, both.anisotropy) == (0.9, 0.5, before.anisotropy)
    both = one.with_overrides(["medium.absorption=0.1", "medium.extinction=0.5"]).medium
    assert (both.absorption, both.extinction) == (0.1, 0.5)


@pytest.mark.parametrize("name", sorted(name for name in presets() if not name.startswith("port.")))
def test_a_preset_gives_its_fields_and_each_can_be_overridden(name):
    section, _, preset = name.partition(".")
    more = {"focal_length": 0.01, "f_number": 2.0} if name == "camera.photon-force-pf32" else {}
    more |= {"point": [0.0, 1.0, 0.0]} if section == "surface" else {}
    base = scene(**{section: {"preset": preset, **more}})
    for field, value in presets(section)[preset].values.items():
        listed = tuple(Constituent(**one) for one in value) if field == "constituents" else value
        assert getattr(getattr(base, section), field) == listed
        if isinstance(value, (int, float)):
            other = int(value * 2) if isinstance(value, int) else value * 0.75 + 0.1
            changed = base.with_overrides({f"{section}.{field}": other})
            assert getattr(getattr(changed, section), field) == other


def test_the_order_is_preset_file_override():
    base = scene(laser={"preset": "lu2024", "pulse_energy": 1e-6})
    assert (base.laser.pulse_energy, base.laser.pulse_fwhm_ps) == (1e-6, 72.0)
    assert base.with_overrides(["laser.pulse_fwhm_ps=50"]).laser.pulse_fwhm_ps == 50.0
    other = base.with_overrides(["laser.preset=picoquant-visuv-532"]).laser
    assert (other.pulse_energy, other.pulse_fwhm_ps, other.half_angle_deg) == (37.5e-9, 85.0, 1.9702)


def test_excluding_fields_displace_each_other_only_across_layers(tmp_path):
    camera = scene(camera={"preset": "lu2024"}).with_overrides({"camera.pixel_pitch_um": 9.2}).camera
    assert camera.horizontal_fov_deg is None
    assert math.degrees(camera.horizontal_fov) == pytest.approx(20.0, abs=0.01)
    assert scene(camera={"preset": "lu2024", "aperture_diameter": 0.02}).camera.f_number is None
    base = scene(targets=[{"builtin": "plane", "size": [1, 2]}])
    target = base.with_overrides({"targets[0].mesh": "/a/bust.stl"}).targets[0]
    assert (target.builtin, target.mesh, target.size) == (None, "/a/bust.stl", None)
    angle = scene(camera={"width": 8, "height": 6, "fx": 30.0, "aperture_diameter": 0.01})
    assert angle.with_overrides({"camera.horizontal_fov_deg": 20.0}).camera.fx is None
    path = tmp_path / "camera.json"
    path.write_text('{"K": [[30, 0, 4], [0, 31, 3], [0, 0, 1]], "dist": [0.1, 0, 0, 0], "image_width": 8}')
    one = scene().with_overrides({"camera.calibration": str(path)}).camera
    assert (one.fx, one.fy, one.distortion[0], one.horizontal_fov_deg) == (30, 31, 0.1, None)
    assert problems(overrides={"camera.calibration": str(path), "camera.width": 9}) == (
        "camera.width = 9 is not 8, the image's of the calibration",
    )


OVERRIDES = {
    "medium.extinction=0.9": (("medium", "extinction"), 0.9),
    " medium.extinction = .9 ": (("medium", "extinction"), 0.9),
    "transport.photons=2e9": (("transport", "photons"), 2e9),
    "transport.seed=0x10": (("transport", "seed"), 16),
    "detector.wrap=false": (("detector", "wrap"), False),
    "medium.preset=jerlov-1C-williamson": (("medium", "preset"), "jerlov-1C-williamson"),
    'medium.albedo="lu2024"': (("medium", "albedo"), "lu2024"),
    "laser.position=[0.1, 0, 0]": (("laser", "position"), [0.1, 0, 0]),
    "targets[0].reflectance=0.3": (("targets", 0, "reflectance"), 0.3),
    "targets.12.mesh=a=b.stl": (("targets", 12, "mesh"), "a=b.stl"),
    "transport.lateral_limit=inf": (("transport", "lateral_limit"), math.inf),
}


def test_overrides_are_toml_or_bare_strings():
    assert {text: parse_override(text) for text in OVERRIDES} == OVERRIDES
    for text in ("medium.extinction", "medium.extinction=", "=3", "0.x=1", "medium..x=1", "a.b=[1,"):
        with pytest.raises(ConfigError, match="override"):
            parse_override(text)


@given(st.text(max_size=40))
def test_any_text_is_an_override_or_a_config_error(text):
    try:
        parse_override(text)
    except ConfigError as error:
        assert "override" in str(error)


def test_overrides_reach_items_of_lists_and_may_add_the_next():
    layers = [{"start": 2.0, "extinction": 1.0, "albedo": 0.5}]
    base = scene(targets=[{"builtin": "plane"}], medium={"extinction": 0.3, "albedo": 0.8, "layers": layers})
    changed = base.with_overrides(["targets[0].reflectance=0.3", "targets.1.builtin=sphere", "targets[1].scale=2"])
    assert [target.builtin for target in changed.targets] == ["plane", "sphere"]
    assert (changed.targets[0].reflectance, changed.targets[1].scale) == (0.3, (2.0, 2.0, 2.0))
    assert base.with_overrides({"targets": []}).targets == ()
    items = {"targets[0].translation[2]": "90 cm", "laser.position[1]": 0.2, "medium.layers[0].extinction": 2.0}
    changed = base.with_overrides(items)
    assert changed.targets[0].translation == (*base.targets[0].translation[:2], 0.9)
    assert changed.laser.position == (base.laser.position[0], 0.2, base.laser.position[2])
    layer = changed.medium.layers[0]
    assert (layer.extinction, layer.albedo, layer.start) == (2.0, 0.5, 2.0)  # overriding one keeps the albedo


def test_derived_quantities():
    one = scene(
        gate={"start_ns": 10.0, "bin_width_ps": 100.0, "bins": 50},
        laser={"wavelength_nm": 532.0, "pulse_energy": 37.5e-9, "half_angle_deg": 15.0, "direction": [0, 3, 4]},
        detector={"pdp": 0.25, "fill_factor": 0.2},
    )
    assert one.gate.stop == pytest.approx(15e-9)
    assert one.path_limit == pytest.approx(SPEED_OF_LIGHT / 1.3638 * 15e-9)
    assert one.with_overrides(["transport.max_path=2"]).path_limit == 2.0
    assert one.with_overrides(["transport.max_path=200"]).path_limit == one.path_limit
    # A 532 nm photon carries 2.3305 eV.
    assert one.laser.photons_per_pulse == pytest.approx(37.5e-9 / (2.330530 * 1.602176634e-19), rel=1e-5)
    assert one.laser.axis == pytest.approx((0.0, 0.6, 0.8))
    assert one.laser.half_angle == pytest.approx(math.pi / 12)
    assert one.detector.pde == pytest.approx(0.05)
    assert one.camera.aperture_area == pytest.approx(math.pi * 0.005**2)


def number_fields(model, path=""):
    """Every field that takes numbers, with its range."""
    for name, info in model.model_fields.items():
        if inner := table_of(model, name):
            yield from number_fields(inner, f"{path}{name}.")
        elif any(part in (int, float) for part in parts_of(info)):
            yield f"{path}{name}", info


# Fields that document infinity.
INFINITE = {"analyser_extinction_ratio", "focus_distance", "distance", "lower", "upper", "lateral_limit", "flux.radius"}


@pytest.mark.parametrize("model", [Scene, Recipe, TrainingRecipe])
def test_every_number_has_a_range(model):
    for path, info in number_fields(model):
        interval, of_a_port = interval_of(info), ".port." in f".{path}"
        assert interval.low > -math.inf or interval.includes_low, path
        assert interval.high < math.inf or interval.includes_high, path
        named = not INFINITE.isdisjoint({path, path.rpartition(".")[2]})
        assert ("inf" in str(interval)) == (named and not of_a_port), path
