"""Ways through flat and dome ports, against rays in float64 that find roots and derivatives by brute force."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import each, on_device, unit
from reference import refraction
from spadwarp_kernels.optics import DOME_PORT, FLAT_PORT, make_dome_port, make_flat_port
from spadwarp_kernels.optics.port import Connection, PortRay

AIR, GLASS, WATER = (1.0003, 1.0003), (1.5195, 1.5463), (1.3415, 1.3638)  # index, group index
Z = np.array([0.0, 0.0, 1.0])
TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
LAYERS = {"oil": ((1.5, 1.52), GLASS, WATER), "surface": (AIR, AIR, WATER)}
LAYERS |= dict.fromkeys(("flat, no port", "dome, no port"), (WATER,) * 3)
SHAPES = {
    "window": dict(distance=0.05, thickness=0.01),
    "tilted": dict(distance=0.05, thickness=0.01, normal=TILT),
    "surface": dict(distance=3.0),
    "oil": dict(distance=0.02, thickness=0.03),
    "flat, no port": dict(distance=0.05, thickness=0.01),
    "concentric": dict(radius=0.05, thickness=0.004),
    "in front": dict(radius=0.05, thickness=0.004, centre=(0.002, -0.001, -0.012)),
    "behind": dict(radius=0.07, thickness=0.006, centre=(0.0, 0.0, 0.02)),
    "dome, no port": dict(radius=0.05, thickness=0.004, centre=(0.0, 0.0, 0.01)),
}


def case(name, **more):
    """Functions and port of the kernels; faces, indices and group indices of the reference, from the water on."""
    index, group = (list(column) for column in zip(*LAYERS.get(name, (AIR, GLASS, WATER)), strict=True))
    shape, thickness = SHAPES[name], SHAPES[name].get("thickness", 0.0)
    if "radius" in shape:
        kind, make = DOME_PORT, make_dome_port
        faces = refraction.dome_faces(np.array(shape.get("centre", (0.0, 0.0, 0.0))), shape["radius"], thickness)
    else:
        kind, make = FLAT_PORT, make_flat_port
        faces = refraction.flat_faces(shape.get("normal", Z), shape["distance"], thickness)
    return kind, make(**shape, index=index, group_index=group, **more), faces, index[::-1], group[::-1]


def points(name, count=60):
    """In the water, near and far, from the axis to 60 degrees; and on a lens of 8 mm; in float32, as the kernels."""
    rng, shape = np.random.default_rng(11), SHAPES[name]
    far = shape.get("distance", 0.0) + shape.get("radius", 0.0) + np.geomspace(0.08, 20.0, count)
    angle, turn = np.radians(rng.uniform(0.0, 60.0, count)), rng.uniform(0.0, 2 * np.pi, count)
    angle[:3] = 0.0, 1e-6, 1e-3
    x = np.stack([np.cos(turn) * np.tan(angle), np.sin(turn) * np.tan(angle), np.ones(count)], axis=1) * far[:, None]
    o = np.concatenate([rng.uniform(-0.004, 0.004, (count, 2)), np.zeros((count, 1))], axis=1)
    o[::4] = 0.0
    return x.astype(np.float32), o.astype(np.float32)


@pytest.mark.parametrize("name", SHAPES)
def test_the_way_to_a_point_inside_is_the_one_that_rays_find(name, device):
    kind, port, faces, n, group = case(name, aperture_radius=0.006, largest_angle=np.radians(75))
    (x, o), shape = points(name), SHAPES[name]
    normal = shape.get("normal", Z)
    if "distance" in shape:
        beyond = x @ normal > shape["distance"] + shape.get("thickness", 0.0) + 1e-3
        x, o = x[beyond], o[beyond]
    found = each(kind.connect, [port, x, o], [Connection], device)
    seen_from = each(kind.apparent, [port, x, o, on_device(found, device, Connection)], [wp.vec3], device)
    limits = dict(to_lens=4e-7, inside=2e-6, water=4e-7, path=5e-7, transmission=2e-6, density=1e-5)
    limits |= dict(exit=1e-6, seen_from=1e-6)
    worst = dict.fromkeys(limits, 0.0)
    for k in range(len(x)):
        p, lens = x[k].astype(np.float64), o[k].astype(np.float64)
        # Rays through oil bend less, rays through air more than the straight line: any start does.
        start = found["to_lens"][k].astype(np.float64)
        assert np.linalg.norm(start) == pytest.approx(1.0, abs=1e-5)
        u, v, lengths, through, density = refraction.connect(faces, n, p, lens, start / np.linalg.norm(start))
        path, straight = np.dot(lengths, group) / group[0], np.linalg.norm(p - lens)
        # Beyond 75 degrees next to no light gets through, and the root is ill-conditioned.
        steep = -v @ normal > np.cos(np.radians(75))
        assert not steep or -float(port.early) - 1e-7 <= path - straight <= float(port.late) + 1e-7
        errors = {
            "to_lens": np.abs(found["to_lens"][k] - u).max(),
            "inside": np.abs(found["inside"][k] - v).max(),
            "water": abs(found["water"][k] - lengths[0]) / straight,
            "path": abs(found["path"][k] - path) / straight,
            "transmission": abs(found["transmission"][k] - through),
            "density": abs(found["density"][k] / density - 1.0) if steep else 0.0,
            "exit": np.linalg.norm(found["exit"][k] - (p + lengths[0] * u)) / straight,
            # The apparent point lies on the ray as it goes straight on.
            "seen_from": np.linalg.norm(np.cross(seen_from[k] - p, u)) / straight,
        }
        worst = {key: max(worst[key], error) for key, error in errors.items()}
    assert {key: value for key, value in worst.items() if value > limits[key]} == {}


def test_solid_angles_behind_a_window_are_those_of_the_contract(device):
    """Per area of a plane parallel to the window, 0.05 m of air and 0.01 m of glass of 1.52, water of 1.34."""
    port = make_flat_port(distance=0.05, thickness=0.01, index=(1.0, 1.52, 1.34), group_index=(1.0, 1.52, 1.34))
    x = np.array([[0, 0, 5], [1, 0, 5], [0, 3, 5], [-4.5, 0, 5], [1, 0, 1]], np.float32)
    found = each(FLAT_PORT.connect, [port, x, 0 * x], [Connection], device)
    on_plane = found["density"] * -found["inside"][:, 2]
    assert on_plane == pytest.approx([0.0397481, 0.0374600, 0.0249011, 0.0157221, 0.2708027], rel=2e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_rays_through_a_port_and_back(name, device):
    kind, port, faces, n, group = case(name)
    (x, _), shape = points(name), SHAPES[name]
    aim = np.random.default_rng(3).uniform(-0.25, 0.25, x.shape) * shape.get("radius", shape.get("distance"))
    u = unit(aim - x).astype(np.float32)
    found = each(kind.leave, [port, x, u], [PortRay], device)
    back = each(kind.enter, [port, found["x"], -found["u"]], [PortRay], device)
    passed = np.flatnonzero(found["transmission"] > 0.0)
    assert passed.size > 20
    for k in passed:
        p = x[k].astype(np.float64)
        y, v, lengths, through = refraction.trace(faces, n, p, u[k] / np.linalg.norm(u[k].astype(np.float64)))
        met, last = refraction.meet_plane(y, v, np.zeros(3), Z)
        size = np.linalg.norm(p) + np.linalg.norm(met)
        # The rounding of far positions, against a dome's radius.
        assert found["u"][k] == pytest.approx(v, abs=3e-6 + 3e-7 * size / shape.get("radius", np.inf))
        assert found["x"][k] == pytest.approx(met, abs=5e-6 * size)
        assert found["water"][k] == pytest.approx(lengths[0], abs=5e-6 * size)
        assert found["path"][k] == pytest.approx((lengths[1] * group[1] + last * group[2]) / group[0], abs=5e-6 * size)
        assert found["transmission"][k] == pytest.approx(through, abs=1e-5)
        assert back["x"][k] == pytest.approx(p + lengths[0] * u[k], abs=1e-5 * size)
        assert back["u"][k] == pytest.approx(-u[k], abs=1e-5)
        assert back["path"][k] == pytest.approx(found["path"][k], abs=5e-6 * size)
        assert back["transmission"][k] == pytest.approx(found["transmission"][k], abs=1e-5)


def test_what_lies_behind_the_port_has_no_way(device):
    x = np.array([[0, 0, 0.03], [0.1, 0, 0.0599], [0, 0, -4.0]], np.float32)
    found = each(FLAT_PORT.connect, [case("window")[1], x, 0 * x], [Connection], device)
    assert not found["density"].any()
    # Beyond the critical angle water lets no light out.
    u = np.array([[0.8, 0.0, -0.6]], np.float32)
    assert each(FLAT_PORT.leave, [case("surface")[1], u * -9, u], [PortRay], device)["transmission"][0] == 0.0
