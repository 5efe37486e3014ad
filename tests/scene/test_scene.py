"""Scenes: media, presets and overrides win in the promised order; errors name field, value and range."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.minimal_scene import CAMERA, MINIMAL, problems, scene
from spadwarp.dataset.recipe import Recipe
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.scene import Camera, Domain, Medium, Scene, load_scene, parse_override, presets
from spadwarp.scene.sections import interval_of, models_of, parts_of
from spadwarp.values import SPEED_OF_LIGHT, ConfigError, FileError, SpadwarpError

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


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_a_medium_takes_exactly_two_coefficients(count):
    values = {"absorption": 0.1, "scattering": 0.2, "extinction": 0.3, "albedo": 2 / 3}
    (problem,) = problems({"medium": dict(list(values.items())[:count])})
    assert problem.startswith(
        "medium needs exactly two of absorption, scattering, extinction, albedo, or chlorophyll; given: "
    )


def test_the_papers_albedo_goes_with_extinction_and_reads_as_its_mean():
    medium = Medium(extinction=0.2, albedo="lu2024")
    assert medium.albedo == "lu2024"
    assert medium.scattering == pytest.approx(0.2 * 0.97 / 2)
    assert medium.absorption + medium.scattering == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("changed", "kept"),
    [("extinction", "albedo"), ("albedo", "extinction"), ("absorption", "scattering"), ("scattering", "absorption")],
)
@pytest.mark.parametrize("base", [{"preset": "uwoc-harbour"}, {"absorption": 0.295, "scattering": 1.875}])
def test_overriding_one_coefficient_keeps_its_partner(changed, kept, base):
    before = Medium(**base)
    after = scene(medium=base).with_overrides({f"medium.{changed}": 0.5}).medium
    assert getattr(after, changed) == 0.5
    assert getattr(after, kept) == getattr(before, kept)
    assert set(after.given) == {changed, kept}


def test_overriding_two_coefficients_replaces_both():
    harbour = scene(medium={"preset": "uwoc-harbour"})
    medium = harbour.with_overrides(["medium.extinction=0.9", "medium.albedo=0.5"]).medium
    assert (medium.extinction, medium.albedo, medium.anisotropy) == (0.9, 0.5, 0.924)
    medium = scene().with_overrides(["medium.absorption=0.1", "medium.extinction=0.5"]).medium
    assert (medium.absorption, medium.extinction) == (0.1, 0.5)


def test_a_single_coefficient_that_leaves_the_papers_albedo_without_a_meaning_is_refused():
    (text,) = problems({"medium": {"preset": "lu2024"}}, {"medium.absorption": 0.1})
    assert text.endswith("; given: absorption, extinction, albedo")
    assert scene(medium={"preset": "lu2024"}).with_overrides(["medium.extinction=0.9"]).medium.albedo == "lu2024"


def test_index_names_stand_for_water_at_532_nm():
    medium = Medium(extinction=1.0, albedo=0.5, group_index="fresh", phase_index="fresh")
    assert (medium.group_index, medium.phase_index) == (1.3566, 1.3350)


@pytest.mark.parametrize("name", sorted(name for name in presets() if not name.startswith("port.")))
def test_a_preset_gives_its_fields_and_each_can_be_overridden(name):
    section, _, preset = name.partition(".")
    lens = {"focal_length": 0.01, "f_number": 2.0} if name == "camera.photon-force-pf32" else {}
    base = scene(**{section: {"preset": preset, **lens}})
    for field, value in presets(section)[preset].values.items():
        assert getattr(getattr(base, section), field) == value
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


def test_excluding_fields_displace_each_other_only_across_layers():
    camera = scene(camera={"preset": "lu2024"}).with_overrides({"camera.pixel_pitch_um": 9.2}).camera
    assert camera.horizontal_fov_deg is None
    assert math.degrees(camera.horizontal_fov) == pytest.approx(20.0, abs=0.01)
    assert scene(camera={"preset": "lu2024", "aperture_diameter": 0.02}).camera.f_number is None
    base = scene(targets=[{"builtin": "plane", "size": [1, 2]}])
    target = base.with_overrides({"targets[0].mesh": "/a/bust.stl"}).targets[0]
    assert (target.builtin, target.mesh, target.size) == (None, "/a/bust.stl", None)


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("medium.extinction=0.9", ("medium", "extinction"), 0.9),
        (" medium.extinction = .9 ", ("medium", "extinction"), 0.9),
        ("transport.photons=2e9", ("transport", "photons"), 2e9),
        ("transport.seed=0x10", ("transport", "seed"), 16),
        ("detector.wrap=false", ("detector", "wrap"), False),
        ("medium.preset=jerlov-1C-williamson", ("medium", "preset"), "jerlov-1C-williamson"),
        ('medium.albedo="lu2024"', ("medium", "albedo"), "lu2024"),
        ("laser.position=[0.1, 0, 0]", ("laser", "position"), [0.1, 0, 0]),
        ("targets[0].reflectance=0.3", ("targets", 0, "reflectance"), 0.3),
        ("targets.12.mesh=a=b.stl", ("targets", 12, "mesh"), "a=b.stl"),
        ("transport.lateral_limit=inf", ("transport", "lateral_limit"), math.inf),
    ],
)
def test_overrides_are_toml_or_bare_strings(text, key, value):
    assert parse_override(text) == (key, value)


@pytest.mark.parametrize(
    "text", ["medium.extinction", "medium.extinction=", "=3", "0.x=1", "medium..x=1", "laser.position=[1,"]
)
def test_malformed_overrides_are_refused(text):
    with pytest.raises(ConfigError, match="override"):
        parse_override(text)


@given(st.text(max_size=40))
def test_any_text_is_an_override_or_a_config_error(text):
    try:
        parse_override(text)
    except ConfigError as error:
        assert "override" in str(error)


def test_overrides_reach_targets_by_index_and_may_add_the_next():
    base = scene(targets=[{"builtin": "plane"}])
    changed = base.with_overrides(["targets[0].reflectance=0.3", "targets.1.builtin=sphere", "targets[1].scale=2"])
    assert [target.builtin for target in changed.targets] == ["plane", "sphere"]
    assert (changed.targets[0].reflectance, changed.targets[1].scale) == (0.3, (2.0, 2.0, 2.0))
    assert base.with_overrides({"targets": []}).targets == ()


@pytest.mark.parametrize(
    "overrides", [["medium.extinction.b=1"], ["targets.reflectance=1"], ["medium[0]=1"], ["targets[0]=1"]]
)
def test_overrides_that_name_no_field_are_refused(overrides):
    (text,) = problems(None, overrides)
    assert "does not name a field" in text


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("medium.anisotropy=1.2", "medium.anisotropy = 1.2 (an override) is outside (-1, 1)"),
        ("medium.albedo=1.5", "medium.albedo = 1.5 (an override) is outside [0, 1] and not 'lu2024'"),
        ("medium.albedo=none", "medium.albedo = 'none' (an override) is neither a number nor 'lu2024'"),
        ("transport.max_collisions=0", "transport.max_collisions = 0 (an override) is outside [1, 2147483647]"),
        ("medium.extinction=-1", "medium.extinction = -1 (an override) is outside [1e-12, 1e6] 1/m"),
        ("transport.axis_threshold=0", "transport.axis_threshold = 0 (an override) is outside (0, 1]"),
        ("transport.max_path=inf", "transport.max_path = inf (an override) is outside (0, 1e12]"),
        ("transport.lateral_limit=nan", "transport.lateral_limit = nan (an override) is outside (0, inf]"),
        ("transport.seed=-1", "transport.seed = -1 (an override) is outside [0, 18446744073709551615]"),
        ("camera.width=3.5", "camera.width = 3.5 (an override) is not an integer"),
        ("camera.width=true", "camera.width = True (an override) is not an integer"),
        ("detector.wrap=1", "detector.wrap = 1 (an override) is not true or false"),
        ("laser.position=[1, 2]", "laser.position = [1, 2] has the wrong number of values"),
        ("laser.direction=[0, 0, 'up']", "laser.direction[2] = 'up' (an override) is not a number"),
        ("laser.direction=[0, 0, 0]", "laser.direction = [0, 0, 0] (an override) has no length"),
        ("targets[0].size=[-1]", "targets[0].size[0] = -1 (an override) is outside [1e-9, 1e9]"),
        ("targets[0].reflectance=2", "targets[0].reflectance = 2 (an override) is outside [0, 1]"),
        ("medium=3", "medium = 3 (an override) is not a table"),
        ("targets=3", "targets = 3 (an override) is not a list"),
        ("medium.absorbtion=1", "medium.absorbtion is not a known field; did you mean 'absorption'?"),
        ("medium.g=0.9", "medium.g is not a known field; did you mean 'anisotropy'?"),
        ("targets[0].color=1", "targets[0].color is not a known field; known are "),
        ("lasser.position=1", "lasser is not a known section; did you mean 'laser'?"),
        ("transport.estimator=nextevent", "transport.estimator = 'nextevent' (an override) is not one of 'analog', '"),
        ("medium.preset=jerlov-1C", "medium.preset = 'jerlov-1C' (an override) is not one of the known presets; did "),
        ("detector.irf=gausian", "detector.irf = 'gausian' (an override) is not one of 'gaussian', "),
    ],
)
def test_errors_name_field_value_and_range(override, message):
    (text,) = problems({"targets": [{"builtin": "plane"}]}, [override])
    assert text.startswith(message)


LENS = {"width": 8, "height": 6, "focal_length": 0.05, "pixel_pitch_um": 100.0, "f_number": 2.0}


@pytest.mark.parametrize(
    ("section", "fields", "message"),
    [
        ("medium", {"absorption": 0.4, "extinction": 0.3}, "absorption = 0.4 is outside [0, 0.3], 0.3 being the ext"),
        ("medium", {"absorption": 0.0, "scattering": 0.0}, "extinction = 0.0 is outside [1e-12, 1e6]"),
        ("medium", {"absorption": 0.1, "albedo": 1.0}, "albedo = 1.0 leaves the extinction undetermined"),
        ("medium", {"absorption": 0.1, "albedo": "lu2024"}, "albedo = 'lu2024' goes with extinction only"),
        ("medium", {**MINIMAL["medium"], "group_index": "salt"}, "group_index = 'salt' is neither a number nor one of"),
        ("domain", {"shape": "slab", "lower": 3, "upper": 1}, "lower = 3.0 is outside (-inf, 1.0), 1.0 being upper"),
        ("laser", {"profile": "gaussian", "half_angle_deg": 90.0}, "half_angle_deg = 90.0 is outside (0, 90), the ra"),
        ("camera", {**CAMERA, "cx": 2.0}, "cx = 2.0 goes with fx only"),
        ("camera", {**CAMERA, "distortion": [0.1, 0.2]}, "distortion = [0.1, 0.2] has the wrong number of values"),
        (
            "camera",
            {**CAMERA, "horizontal_fov_deg": 120.0, "distortion": [-0.4, 0, 0, 0]},
            "distortion = [-0.4, 0.0, 0.0, 0.0, 0.0] is not one-to-one",
        ),
        ("camera", {**LENS, "focus_distance": 0.04}, "focus_distance = 0.04 is outside (0.05, inf], beyond the focal"),
    ],
)
def test_fields_that_contradict_each_other_are_refused(section, fields, message):
    (text,) = problems({section: fields})
    assert text.startswith(f"{section}.{message}")


@pytest.mark.parametrize(
    ("tables", "override", "message"),
    [
        (
            {"camera": {**CAMERA, "fx": 20.0}},
            None,
            "camera needs one of horizontal_fov_deg, fx, and pixel_pitch_um with focal_length; "
            "given: horizontal_fov_deg, fx",
        ),
        (
            {"camera": {**CAMERA, "f_number": 2.0}},
            None,
            "camera needs either aperture_diameter or f_number with focal_length",
        ),
        (
            {"targets": [{"builtin": "plane"}]},
            ["targets[2].scale=2"],
            "targets[2] does not exist; targets has 1 values, from 0 on",
        ),
        (
            {"targets": {"builtin": "plane"}},
            None,
            "targets = {'builtin': 'plane'} is not a list of tables; write [[targets]]",
        ),
    ],
)
def test_what_is_missing_is_named(tables, override, message):
    assert problems(tables, override) == (message,)


def test_every_problem_has_its_line_with_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(
        "[medium]\nextinction = 0.3\nalbedo = 0.8\nanisotropy = 1.2\n[camera]\nwidth = 4\n[gate]\nbins = 0\n"
    )
    with pytest.raises(ConfigError) as caught:
        load_scene(path, ["laser.profile=gauss"])
    assert str(caught.value).splitlines() == [
        f"{path}: medium.anisotropy = 1.2 is outside (-1, 1)",
        f"{path}: laser.profile = 'gauss' (an override) is not one of 'uniform_cone', 'gaussian', 'collimated', "
        "'measured'; did you mean 'gaussian'?",
        f"{path}: camera.height is missing (rows)",
        f"{path}: gate.bin_width_ps is missing (width of a bin [ps])",
        f"{path}: gate.bins = 0 is outside [1, 1000000]",
    ]
    assert isinstance(caught.value, SpadwarpError)


def test_a_missing_or_broken_file_is_named(tmp_path):
    with pytest.raises(FileError, match=r"nowhere\.toml: cannot be read: No such file"):
        load_scene(tmp_path / "nowhere.toml")
    broken = tmp_path / "broken.toml"
    with pytest.raises(FileError, match=r"did you mean 'broken\.toml'"):
        broken.write_bytes(b"")
        load_scene(tmp_path / "brokn.toml")
    broken.write_bytes(b"[medium\n")
    with pytest.raises(ConfigError, match=r"broken\.toml: not valid TOML"):
        load_scene(broken)
    broken.write_bytes(b"\xff\xfe")
    with pytest.raises(FileError, match=r"broken\.toml: not a text file"):
        load_scene(broken)


@pytest.mark.parametrize("line", ["aperture_diameter = 20 mm", "position = [0, 20mm, 0]"])
def test_a_number_with_a_unit_needs_quotes(line, tmp_path):
    (tmp_path / "scene.toml").write_text(f"[camera]\nwidth = 4\n{line}\n")
    with pytest.raises(ConfigError, match=r'line 3, .*; a number with a unit needs quotes: "20 mm"'):
        load_scene(tmp_path / "scene.toml")


@pytest.mark.parametrize(("name", "words"), [("a.stl", "SCENE --mesh"), ("a.h5", "results")])
def test_files_of_another_kind_are_no_scene(name, words, tmp_path):
    (tmp_path / name).write_bytes(b"\xff")
    with pytest.raises(FileError, match=f"not a scene; .*{words}"):
        load_scene(tmp_path / name)


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
    assert one.medium.attenuation_length == pytest.approx(1 / 0.3)
    assert one.camera.aperture_area == pytest.approx(math.pi * 0.005**2)


def test_both_ways_to_give_a_camera_agree():
    by_angle = Camera(width=40, height=30, horizontal_fov_deg=2 * math.degrees(math.atan(0.2)), aperture_diameter=0.005)
    by_lens = Camera(width=40, height=30, focal_length=0.01, pixel_pitch_um=100.0, f_number=2.0)
    for camera in (by_angle, by_lens):
        assert camera.pixel_tangent == pytest.approx(0.01)
        assert camera.aperture_radius == pytest.approx(0.0025)
        assert math.tan(camera.horizontal_fov / 2) == pytest.approx(0.2)
        assert math.tan(camera.vertical_fov / 2) == pytest.approx(0.15)


def test_a_domain_has_only_the_bounds_of_its_shape():
    inf = math.inf
    assert Domain(lower=1, upper=[2, 3, 4]).bounds == ((-inf,) * 3, (inf,) * 3)
    assert Domain(shape="slab", lower=0, upper=2).bounds == ((-inf, -inf, 0.0), (inf, inf, 2.0))
    assert Domain(shape="box", lower=-1, upper=[2, 3, 4]).bounds == ((-1.0,) * 3, (2.0, 3.0, 4.0))


def test_every_field_is_documented():
    for section in (scene().medium, scene().laser, scene().camera, scene().detector, scene().gate, scene().domain):
        for name, info in type(section).model_fields.items():
            assert info.description, f"{section.section}.{name}"


def test_a_later_layer_gives_the_camera_in_another_way(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"K": [[30, 0, 4], [0, 31, 3], [0, 0, 1]], "dist": [0.1, 0, 0, 0], "image_width": 8}')
    one = scene().with_overrides({"camera.calibration": str(path)}).camera
    assert (one.fx, one.fy, one.distortion[0], one.horizontal_fov_deg) == (30, 31, 0.1, None)
    angle = scene(camera={"width": 8, "height": 6, "fx": 30.0, "aperture_diameter": 0.01})
    assert angle.with_overrides({"camera.horizontal_fov_deg": 20.0}).camera.fx is None
    assert problems(overrides={"camera.calibration": str(path), "camera.width": 9}) == (
        "camera.width = 9 is not 8, the image's of the calibration",
    )


def number_fields(model, path=""):
    """Every field that takes numbers, with its range."""
    for name, info in model.model_fields.items():
        inner = models_of(info)
        for one in inner:
            yield from number_fields(one, f"{path}{name}.")
        if not inner and any(part in (int, float) for part in parts_of(info)):
            yield pytest.param(info, id=f"{path}{name}")


# Fields that document infinity.
INFINITE = {"analyser_extinction_ratio", "focus_distance", "distance", "lower", "upper", "lateral_limit"}


@pytest.mark.parametrize("info", [*number_fields(Scene), *number_fields(Recipe), *number_fields(TrainingRecipe)])
def test_every_number_has_a_range(info, request):
    name = request.node.callspec.id.rpartition(".")[2]
    interval, of_a_port = interval_of(info), ".port." in request.node.callspec.id
    assert interval.low > -math.inf or interval.includes_low
    assert interval.high < math.inf or interval.includes_high
    assert ("inf" in str(interval)) == (name in INFINITE and not of_a_port)


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


ODD = {"deep": nested(5000), "digits": 10**5000, "table": {"a": nested(5000)}, "surrogate": "\ud800", "bytes": b"x"}


@pytest.mark.parametrize("value", ODD.values(), ids=ODD)
@pytest.mark.parametrize("field", ["medium.preset", "medium.extinction", "camera.width", "targets", "laser.profile"])
def test_any_object_is_a_value_or_refused_in_a_line(field, value):
    section, _, name = field.partition(".")
    tables = {section: {**MINIMAL.get(section, {}), name: value}} if name else {section: value}
    (first, *_) = problems(tables)
    assert first.startswith(section) and len(first) < 500
