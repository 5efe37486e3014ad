"""What a wrong scene is answered with: field, value, range, unit, and the way out."""

import pytest

import spadwarp
from helpers.minimal_scene import CAMERA, MINIMAL, problems
from spadwarp.values import ConfigError, FileError, SpadwarpError

BASE = {**MINIMAL, "targets": [{"builtin": "plane"}]}
LENS = {"width": 8, "height": 6, "focal_length": 0.05, "pixel_pitch_um": 100.0, "f_number": 2.0}
PORT = {"distance": 0.05, "thickness": 0.01, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.05, "thickness": 0.004, "material": "acrylic"}
CLOUD = {"shape": "cloud", "size": [1.0, 2.0, 1.5], "cells": 20, "extinction": 2.0}
BOX = 'domain={shape="box", lower=[-1, -1, -1], upper=[1, 1, 9]'
LAYER = {"start": 1.0, "extinction": 1.0, "albedo": 0.5}
TWO_OF = "medium needs exactly two of absorption, scattering, extinction, albedo, or chlorophyll; given: "
GIVEN_BY = "camera needs one of horizontal_fov_deg, fx, and pixel_pitch_um with focal_length; given: "


def medium(**fields):
    return {"medium": {**MINIMAL["medium"], **fields}}


def grid(**fields):
    return medium(grid={**CLOUD, **fields})


def camera(**fields):
    return {"camera": {**CAMERA, **fields}}


def laser(**fields):
    return {"laser": fields}


def port(*names, **fields):
    """A window, less what is named."""
    return camera(port={name: value for name, value in {**PORT, **fields}.items() if name not in names})


@pytest.mark.parametrize(
    ("change", "text"),
    [
        # Ranges and kinds
        ("medium.anisotropy=1.2", "medium.anisotropy = 1.2 (an override) is outside (-1, 1)"),
        ("medium.albedo=1.5", "medium.albedo = 1.5 (an override) is outside [0, 1] and not 'lu2024'"),
        ("medium.extinction=-1", "medium.extinction = -1 (an override) is outside [1e-12, 1e6] 1/m"),
        ("camera.width=3.5", "camera.width = 3.5 (an override) is not an integer in [1, "),
        ("laser.position=0.04,0,0", "is a list: write [0.04,0,0]"),
        ("detector.pde=0.3", "detector.pde is not a known field; it is pdp · fill_factor"),
        ("laser.wavelengths_nm=[0, 532]", "laser.wavelengths_nm[0] = 0 (an override) is outside [1e-9, 1e6] nm"),
        ("detector.wrap=1", "detector.wrap = 1 (an override) is not true or false"),
        ("laser.position=[1, 2]", "laser.position = [1, 2] has the wrong number of values"),
        ("laser.direction=[0, 0, 'up']", "laser.direction[2] = 'up' (an override) is not a number"),
        ("medium=3", "medium = 3 (an override) is not a table"),
        ({"targets": {"builtin": "plane"}}, "= {'builtin': 'plane'} is not a list of tables; write [[targets]]"),
        ("camera.rotation_deg=10", "camera.rotation_deg = 10 (an override) is not a list of 3 values"),
        # Names
        ("medium.absorbtion=1", "medium.absorbtion is not a known field; did you mean 'absorption'?"),
        ("lasser.position=1", "lasser is not a known section; did you mean 'laser'?"),
        ("transport.estimator=nextevent", "transport.estimator = 'nextevent' (an override) is not one of 'analog', '"),
        (
            "medium.preset=jerlov-1C",
            "medium.preset = 'jerlov-1C' (an override) is not one of those of `spadwarp list pre",
        ),
        ("medium=uwoc-harbour", '; a preset is taken by {preset = "uwoc-harbour"}'),
        ("medium.extinction.b=1", "does not name a field"),
        ("targets[2].scale=2", "targets[2] does not exist; targets ends at targets[0]"),
        ("medium.layers=[{extinction=0.4}]", "medium.layers[0].start is missing"),
        ("laser.pulse_energy[0]=1", "laser.pulse_energy = 3.75e-08 is not a list"),
        # Units
        ("laser.pulse_energy=150 ns", "laser.pulse_energy = '150 ns' (an override) is a time; an energy is needed"),
        ("targets[0].translation=[0, '2 ps', 4]", "targets[0].translation = [0, '2 ps', 4] (an override) holds '2 ps'"),
        ("detector.pdp=3 x", "detector.pdp = '3 x' (an override) is text; a number without quotes"),
        ("detector.pdp=25", 'detector.pdp = 25 (an override) is outside [0, 1]; did you mean "25 %"?'),
        ("targets[0].scale='1 mm'", "; for a mesh in units of 1 mm write 0.001"),
        ("laser.pulse_energy=[20 mJ]", '; a number with a unit needs quotes: "20 mJ"'),
        # Water
        ({"medium": {}}, TWO_OF),
        (medium(scattering=0.1), TWO_OF),
        ({"medium": {"absorption": 0.4, "extinction": 0.3}}, "absorption = 0.4 is outside [0, 0.3] 1/m, 0.3 being"),
        ({"medium": {"absorption": 0.1, "albedo": 1.0}}, "medium.albedo = 1.0 leaves the extinction undetermined"),
        ({"medium": {"chlorophyll": 0.5, "preset": "uwoc-clear"}}, "chlorophyll = 0.5 cannot be combined with preset"),
        ({"medium": {"chlorophyll": 0.5}, **laser(wavelength_nm=850.0)}, "wavelength_nm = 850.0 is outside [400, 700]"),
        (medium(phase_function="tabulated"), "medium needs phase_table with phase_function = 'tabulated'"),
        (medium(phase_table="a.csv"), "medium.phase_table = 'a.csv' goes with phase_function = 'tabulated' only"),
        (medium(phase_table="petzold"), "phase_table = 'petzold' is not one of 'petzold-average-particle', 'clean-bub"),
        # Cells of water
        (medium(grid={}), "medium.grid needs either file or shape"),
        (medium(grid={"shape": "plume"}), "medium.grid needs size with shape = 'plume'"),
        ("medium.grid.file=smoke.vdb", "grid.file = 'smoke.vdb' does not end in .npz, .h5, .hdf5, .nvdb; `nanovdb"),
        (medium(grid={"file": "a.npz", "turbulence": 1.0}), "medium.grid.turbulence = 1.0 goes with shape only"),
        (grid(size=[1.0, 1.0]), "medium.grid.size = [1.0, 1.0] has two numbers"),
        (medium(grid=CLOUD, layers=[LAYER]), "grid does not go with layers"),
        (medium(grid={**CLOUD, "anisotropy": 0.5}, phase_function="fournier_forand"), "anisotropy = 0.5 goes with ph"),
        ({**grid(), "daylight": {"sun_elevation_deg": 45.0, "depth": 5.0}}, "medium.grid does not go with daylight"),
        # Daylight
        ("daylight={sun_elevation_deg=45}", "daylight.depth is missing (of the lens below the surface [m])"),
        ({**medium(layers=[LAYER]), "daylight": {"sun_elevation_deg": 60.0, "depth": 5.0}}, "daylight takes one water"),
        # Walls
        ({"domain": {"shape": "slab", "lower": 3, "upper": 1}}, "lower = 3.0 is outside (-inf, 1.0) m, 1.0 being"),
        ('domain={shape="box", upper=[1, 1]}', "domain.upper = [1, 1] has the wrong number of values; 3 are needed"),
        ("domain={outside_index={y_low=1.0}}", "no such face with shape = 'unbounded'; a slab has z_low and z_high"),
        (BOX + ", outside_index={y_lw=1.0}}", "did you mean 'y_low'?"),
        # Lasers and their spectrum
        (laser(profile="gaussian", half_angle_deg=90.0), "half_angle_deg = 90.0 is outside (0, 90) °, the range of a"),
        ("laser.profile=measured", "needs profile_image with profile = 'measured': the path of an image"),
        (laser(pulse_energy=1.0, average_power=2.0), "laser needs one of pulse_energy, average_power, peak_power"),
        (laser(peak_power=1.0, pulse_fwhm_ps=0.0), "laser.peak_power = 1.0 needs pulse_fwhm_ps > 0"),
        (laser(spectrum="led.txt"), "is not the path of a .csv file"),
        # Cameras
        (camera(cx=2.0), "camera.cx = 2.0 goes with fx only"),
        (camera(fx=20.0), GIVEN_BY + "horizontal_fov_deg, fx"),
        (camera(f_number=2.0), "camera needs either aperture_diameter or f_number with focal_length"),
        (camera(horizontal_fov_deg=120.0, distortion=[-0.4, 0, 0, 0]), "[-0.4, 0.0, 0.0, 0.0, 0.0] is not one-to-one"),
        ({"camera": {**LENS, "focus_distance": 0.04}}, "focus_distance = 0.04 is outside (0.05, inf] m, beyond the "),
        ({**camera(pinhole=True), "transport": {"estimator": "analog"}}, "does not go with transport.estimator = 'ana"),
        # Ports
        ('camera.port={distance="5 cm", thickness="10 ns"}', "thickness = '10 ns' (an override) is a time; a length"),
        ('camera.port={preset="dome-acryl"}', "did you mean 'dome-acrylic'?"),
        ('camera.port={preset="dome-acrylic", distance=0.05}', "distance = 0.05 goes with shape = 'flat' only"),
        ('camera.port={preset="dome-acrylic", offset=[0, 0, 0.06]}', "outside: it is 0.06 m from the dome's centre"),
        (port("distance"), "camera.port needs distance with shape = 'flat'"),
        (port(index=1.5), "camera.port needs either material or index"),
        (port("material"), "camera.port needs material or index and a thickness > 0, or neither"),
        (camera(port={**DOME, "normal": [0.0, 0.1, 1.0]}), "goes with shape = 'flat' only"),
        (
            {**camera(port=DOME), **laser(wavelength_nm=355.0)},
            "acrylic' is known for [436.8, 1052] nm, not for laser.wavelength_nm = 355",
        ),
        ({**port(), "scan": {"mode": "confocal"}}, "scan.mode = 'confocal' behind a port needs laser.port"),
        ("laser.port=flat-glass", 'a preset is taken by {preset = "flat-glass"}'),
        ("laser.port=camera", "laser.port = 'camera' needs a camera.port"),
        (
            {**camera(port={"preset": "dome-acrylic"}), **laser(port="camera", position=[-0.12, 0, 0])},
            "laser.position = [-0.12, 0.0, 0.0] is outside laser.port: it is 0.12 m from the dome's centre, the radius "
            "is 0.05 m; move the laser, or give it a port of its own: [laser.port]",
        ),
    ],
)
def test_one_problem_is_named_in_one_line(change, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tables, overrides = (change, None) if isinstance(change, dict) else ({}, [change])
    found = problems({**BASE, **tables}, overrides)
    assert len(found) == 1 and text in found[0].replace(f"{tmp_path}/", "")


def test_every_problem_has_its_line_with_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("[medium]\nextinction = 0.3\nalbedo = 0.8\nanisotropy = 1.2\n[camera]\nwidth = 4\n[gate]\nbins=0\n")
    with pytest.raises(ConfigError) as caught:
        spadwarp.load_scene(path, ["laser.profile=gauss"])
    assert str(caught.value).splitlines() == [
        f"{path}: medium.anisotropy = 1.2 is outside (-1, 1)",
        f"{path}: laser.profile = 'gauss' (an override) is not one of 'uniform_cone', 'gaussian', 'collimated', "
        "'measured'; did you mean 'gaussian'?",
        f"{path}: camera.height is missing (rows)",
        f"{path}: gate.bin_width_ps is missing (width of a bin [ps])",
        f"{path}: gate.bins = 0 is outside [1, 1000000]",
    ]
    assert isinstance(caught.value, SpadwarpError)


@pytest.mark.parametrize(
    ("name", "content", "error", "text"),
    [
        ("nowhere.toml", None, FileError, "nowhere.toml: cannot be read: No such file"),
        ("brokn.toml", None, FileError, "did you mean 'broken.toml'"),
        ("a.toml", b"[medium\n", ConfigError, "a.toml: not valid TOML"),
        ("a.toml", b"\xff\xfe", FileError, "a.toml: not a text file"),
        ("a.toml", b"[camera]\nheight = 20 mm\n", ConfigError, '; a number with a unit needs quotes: "20 mm"'),
        ("a.toml", b"[camera]\nposition = [0, 20mm, 0]\n", ConfigError, "line 2, "),
        ("a.stl", b"\xff", FileError, "SCENE --mesh"),
        ("a.h5", b"\xff", FileError, "not a scene; "),
    ],
)
def test_files_that_are_no_scene_are_named(name, content, error, text, tmp_path):
    (tmp_path / "broken.toml").touch()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(error) as caught:
        spadwarp.load_scene(tmp_path / name)
    assert text in str(caught.value)


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


def test_assigning_to_a_field_leads_to_with_overrides():
    scene = spadwarp.Scene.from_dict(BASE)
    for place, name in ((scene, "medium"), (scene.medium, "scattering"), (scene.targets[0], "nonsense")):
        with pytest.raises(AttributeError, match=rf"^{name} cannot be assigned.*with_overrides"):
            setattr(place, name, 1.0)
