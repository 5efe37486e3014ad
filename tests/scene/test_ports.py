"""Ports in scenes: what is refused, indices, lines of sight and depths along bent rays."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.scenes import WATER, scene
from reference import refraction
from spadwarp.mesh import build_mesh, focus_distance
from spadwarp.scene import Scene
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.port import air_indices, window_indices
from spadwarp.scene.scene import camera_port
from spadwarp.scene.sections import PRESETS
from spadwarp.scene.sight import depth_from_time, lines_of_sight

SEAWATER = WATER | {"phase_index": "seawater", "group_index": "seawater"}
WINDOW = {"distance": 0.05, "thickness": 0.01, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.05, "thickness": 0.004, "material": "acrylic"}
CAMERA = {"width": 12, "height": 10, "horizontal_fov_deg": 60.0, "aperture_diameter": 0.005}


def ported(port, laser_port=None, **sections):
    behind, laser = ({} if one is None else {"port": one} for one in (port, laser_port))
    laser |= {"position": [0.01, 0.0, 0.0]}
    return scene(**{"medium": SEAWATER, "camera": CAMERA | behind, "laser": laser} | sections)


PUBLISHED = [("BK7", 587.56, 1.51680), ("BK7", 486.13, 1.52238), ("fused silica", 589.29, 1.45840)]
PUBLISHED += [("sapphire", 589.3, 1.76817), ("acrylic", 587.6, 1.4906), ("polycarbonate", 587.6, 1.5849)]


@pytest.mark.parametrize(("material", "wavelength", "index"), PUBLISHED)
def test_indices_of_windows_are_those_of_their_sources(material, wavelength, index):
    found, group = window_indices(material, wavelength)
    assert found == pytest.approx(index, abs=2e-4)
    slope = np.subtract(*(window_indices(material, wavelength + step)[0] for step in (0.01, -0.01))) / 0.02
    assert group == pytest.approx(found - wavelength * slope, abs=1e-8)


def test_air():
    """Ciddor 1996 at 589 nm; and the group index from the slope."""
    index, group = air_indices(589.3)
    assert index - 1.0 == pytest.approx(2.7717e-4, rel=1e-3)
    slope = (air_indices(590.3)[0] - air_indices(588.3)[0]) / 2.0
    assert group == pytest.approx(index - 589.3 * slope, abs=1e-9)


def test_presets_overrides_and_files_of_scenes():
    one = ported({"preset": "flat-sapphire"}).with_overrides({"camera.port.distance": 0.2, "camera.width": 8})
    assert (one.camera.port.material, one.camera.port.distance, one.camera.port.thickness) == ("sapphire", 0.2, 0.008)
    assert Scene.from_toml(one.to_toml()) == one
    other = one.with_overrides(["camera.port.shape=dome", "camera.port.radius=0.1", "camera.port.index=1.5"])
    assert other.camera.port.material is None and other.camera.port.distance is None
    assert one.with_overrides({"camera.port": None}).camera.port is None
    for name, preset in PRESETS["port"].items():
        more = {} if "distance" in preset.values or preset.values["shape"] == "dome" else {"distance": 0.3}
        port = ported({"preset": name, **more}, laser_port="camera").camera.port
        assert all(getattr(port, field) == value for field, value in preset.values.items())


CASES = {
    "flat": (WINDOW, None),
    "tilted, laser behind it": (WINDOW | {"normal": [0.1, -0.2, 1.0]}, "camera"),
    "dome": (DOME | {"offset": [0.002, 0.0, -0.006]}, "camera"),
    "from the air": ({"distance": 0.8}, {"distance": 0.8}),
    "laser alone": (None, WINDOW),
}


def reference_paths(one, port, place, points):
    """Paths of light from points to a place behind the port [m of water], by rays that find their way in float64."""
    if port is None:
        return np.linalg.norm(points - place, axis=1)
    behind, total = camera_port(one.with_overrides({"camera.port": port})), []
    if behind.shape == "flat":
        faces = refraction.flat_faces(np.array(behind.normal), behind.distance, behind.thickness)
    else:
        faces = refraction.dome_faces(np.array(behind.centre), behind.radius, behind.thickness)
    for point in points:
        start = place - point
        lengths = refraction.connect(faces, behind.index[::-1], point, place, start / np.linalg.norm(start))[2]
        total.append(np.dot(lengths, behind.group_index[::-1]) / behind.group_index[2])
    return np.array(total)


@pytest.mark.parametrize("name", CASES)
def test_depth_of_a_plane_is_recovered_over_the_field(name):
    """Within 0.1 mm, from times of rays that know nothing of lines of sight."""
    port, laser_port = CASES[name]
    one = ported(port, laser_port)
    truth = spadwarp.truth_maps(one, device="cpu")
    depth = np.full(truth.depth.shape, 2.2)
    assert np.nanmax(np.abs(truth.depth - 2.2)) < 1e-5
    lines = lines_of_sight(one)
    points = lines.points(lines.range_from_depth(depth))
    assert points[..., 2] == pytest.approx(2.2)
    assert truth.range == pytest.approx(lines.range_from_depth(depth), rel=1e-6)
    own = port if laser_port == "camera" else laser_port
    ends = ((port, np.zeros(3)), (own, np.array(one.laser.position)))
    path = sum(reference_paths(one, *end, points.reshape(-1, 3)) for end in ends).reshape(depth.shape)
    assert lines.path_from_range(truth.range.astype(np.float64)) == pytest.approx(path, abs=2e-6)
    assert np.abs(depth_from_time(path / one.medium.pulse_speed, scene=one) - 2.2).max() < 1e-4


def test_what_a_model_without_the_port_makes_of_its_times():
    """Depth from times with the directions of air, as an in-air calibration has it: too far at the edge by the ratio of
    the cosines, too near by what air is faster than water."""
    one = ported(WINDOW, "camera", laser={"position": [0.0, 0.0, 0.0], "port": "camera"})
    lines = lines_of_sight(one)
    times = lines.path_from_range(lines.range_from_depth(np.full((10, 12), 5.0))) / one.medium.pulse_speed
    bare = one.with_overrides({"camera.port": None, "laser.port": None})
    view = pixel_directions(one.camera)
    sine = np.hypot(view[..., 0], view[..., 1])
    in_air = np.sqrt(1.0 - sine**2)
    (n_air, g_air), (n_glass, g_glass) = one.camera.port.indices(532.0)
    in_glass, in_water = (np.sqrt(1.0 - (sine * n_air / n) ** 2) for n in (n_glass, 1.3415))
    path = (0.05 * g_air / in_air + 0.01 * g_glass / in_glass) / 1.3638 + 4.94 / in_water
    assert depth_from_time(times, scene=bare) == pytest.approx(path * in_air, abs=1e-9)


def test_a_lens_focuses_on_what_it_sees_through_the_port():
    """0.187 m behind a concentric dome of 5 cm for a target at 5 m; n0/nw of the depth behind a window."""
    target = [{"builtin": "plane", "size": [3.0, 3.0], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}]
    one = ported(DOME, targets=target)
    assert focus_distance(one, build_mesh(one)) == pytest.approx(0.187, abs=5e-4)
    one = ported(WINDOW, targets=target)
    (n_air, _), (n_glass, _) = one.camera.port.indices(532.0)
    expected = 0.05 + 0.01 * n_air / n_glass + 4.94 * n_air / 1.3415
    assert focus_distance(one, build_mesh(one)) == pytest.approx(expected, rel=1e-6)
    assert focus_distance(ported(WINDOW, targets=[]), None) > 1e5
    assert type(focus_distance(one, build_mesh(one))) is float  # as fields are, also where a fit fixes them


def test_check_knows_the_port():
    one = ported(WINDOW, "camera")
    (message,) = [m for m in spadwarp.check(one) if m.field == "camera.port"]
    half = math.degrees(math.asin(math.sin(math.radians(30.0)) * air_indices(532.0)[0] / 1.3415))
    assert message.values["wide_deg"] == pytest.approx(2.0 * half, abs=1e-6)
    surface = ported({"distance": 1.0}, domain={"shape": "slab", "lower": 1.0, "upper": 9.0})
    assert all(m.level == "note" for m in spadwarp.check(surface) if m.field == "camera.port")
    open_water = ported({"distance": 1.0})
    assert any(m.level == "warning" and "calm surface" in m.text for m in spadwarp.check(open_water))
    one = one.with_overrides({"laser.half_angle_deg": 60.0})
    lines = lines_of_sight(one)
    depth = np.full((10, 12), 2.2)
    low, high = spadwarp.checks.summary(one)["target_range"]
    ranges = lines.range_from_depth(depth)
    assert low == pytest.approx(ranges.min(), abs=0.02) and high == pytest.approx(ranges.max(), abs=0.1)
