"""Ways through flat and dome ports, against rays in float64 that find roots and derivatives by brute force."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import Vectors, launched
from reference import refraction
from spadwarp_kernels import ArgumentError
from spadwarp_kernels.optics import DOME_PORT, FLAT_PORT, Port, make_dome_port, make_flat_port
from spadwarp_kernels.optics.port import Connection, PortRay

AIR, GLASS, WATER = (1.0003, 1.0003), (1.5195, 1.5463), (1.3415, 1.3638)


def _kernels(kind):
    connect, apparent, leave, enter = kind.connect, kind.apparent, kind.leave, kind.enter

    @wp.kernel(enable_backward=False, module="unique")
    def connections(port: Port, x: Vectors, o: Vectors, out: wp.array(dtype=Connection), seen_from: Vectors):
        i = wp.tid()
        out[i] = connect(port, x[i], o[i])
        seen_from[i] = apparent(port, x[i], o[i], out[i])

    @wp.kernel(enable_backward=False, module="unique")
    def passages(port: Port, x: Vectors, u: Vectors, out: wp.array(dtype=PortRay), back: wp.array(dtype=PortRay)):
        i = wp.tid()
        out[i] = leave(port, x[i], u[i])
        back[i] = enter(port, out[i].x, -out[i].u)

    return connections, passages


KERNELS = {kind.name: _kernels(kind) for kind in (FLAT_PORT, DOME_PORT)}


def indices(*layers):
    return {"index": [n for n, _ in layers], "group_index": [n for _, n in layers]}


TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
FLAT = {
    "window": dict(distance=0.05, thickness=0.01, **indices(AIR, GLASS, WATER)),
    "tilted": dict(distance=0.05, thickness=0.01, normal=TILT, **indices(AIR, GLASS, WATER)),
    "surface": dict(distance=3.0, **indices(AIR, AIR, WATER)),
    "oil": dict(distance=0.02, thickness=0.03, **indices((1.5, 1.52), GLASS, WATER)),
    "none": dict(distance=0.05, thickness=0.01, **indices(WATER, WATER, WATER)),
}
DOME = {
    "concentric": dict(radius=0.05, thickness=0.004, **indices(AIR, GLASS, WATER)),
    "in front": dict(radius=0.05, thickness=0.004, centre=(0.002, -0.001, -0.012), **indices(AIR, GLASS, WATER)),
    "behind": dict(radius=0.07, thickness=0.006, centre=(0.0, 0.0, 0.02), **indices(AIR, GLASS, WATER)),
    "none": dict(radius=0.05, thickness=0.004, centre=(0.0, 0.0, 0.01), **indices(WATER, WATER, WATER)),
}


def faces_of(options):
    thickness = options.get("thickness", 0.0)
    if "radius" in options:
        return refraction.dome_faces(np.array(options.get("centre", (0.0, 0.0, 0.0))), options["radius"], thickness)
    return refraction.flat_faces(np.array(options.get("normal", (0.0, 0.0, 1.0))), options["distance"], thickness)


def points(options, count=60):
    """In the water, near and far, from the axis to 60 degrees; and on a lens of 8 mm."""
    rng = np.random.default_rng(11)
    far = options.get("distance", 0.0) + options.get("radius", 0.0) + np.geomspace(0.08, 20.0, count)
    angle, turn = np.radians(rng.uniform(0.0, 60.0, count)), rng.uniform(0.0, 2 * np.pi, count)
    angle[:3] = 0.0, 1e-6, 1e-3
    aside = np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.tan(angle)[:, None]
    x = np.concatenate([aside, np.ones((count, 1))], axis=1) * far[:, None]
    o = np.concatenate([rng.uniform(-0.004, 0.004, (count, 2)), np.zeros((count, 1))], axis=1)
    o[::4] = 0.0
    # What the kernels get, in float32.
    return x.astype(np.float32), o.astype(np.float32)


CASES = [("flat", name, FLAT[name]) for name in FLAT] + [("dome", name, DOME[name]) for name in DOME]


def made(kind, options, **more):
    return (make_flat_port if kind == "flat" else make_dome_port)(**options, **more)


@pytest.mark.parametrize(("kind", "name", "options"), CASES, ids=lambda value: value if isinstance(value, str) else "")
def test_the_way_to_a_point_inside_is_the_one_that_rays_find(kind, name, options, device):
    port = made(kind, options, aperture_radius=0.006, largest_angle=np.radians(75))
    x, o = points(options)
    faces, n, group = faces_of(options), options["index"][::-1], options["group_index"]
    normal = np.array(options.get("normal", (0.0, 0.0, 1.0)))
    if kind == "flat":
        beyond = x @ normal > options["distance"] + options.get("thickness", 0.0) + 1e-3
        x, o = x[beyond], o[beyond]
    found, seen_from = launched(KERNELS[kind][0], [port, x, o], [Connection, wp.vec3], device)
    worst = dict.fromkeys(("to_port", "inside", "water", "path", "transmission", "density", "exit", "seen_from"), 0.0)
    for k in range(len(x)):
        p, lens = x[k].astype(np.float64), o[k].astype(np.float64)
        # Rays through oil bend less, rays through air more than the straight line: any start does.
        start = found["to_port"][k].astype(np.float64)
        assert np.linalg.norm(start) == pytest.approx(1.0, abs=1e-5)
        u, v, lengths, through, density = refraction.connect(faces, n, p, lens, start / np.linalg.norm(start))
        path = (lengths[0] * group[2] + lengths[1] * group[1] + lengths[2] * group[0]) / group[2]
        straight = np.linalg.norm(p - lens)
        if -v @ normal > np.cos(np.radians(75)):
            assert -float(port.early) - 1e-7 <= path - straight <= float(port.late) + 1e-7
        errors = {
            "to_port": np.abs(found["to_port"][k] - u).max(),
            "inside": np.abs(found["inside"][k] - v).max(),
            "water": abs(found["water"][k] - lengths[0]) / straight,
            "path": abs(found["path"][k] - path) / straight,
            "transmission": abs(found["transmission"][k] - through),
            # Beyond 75 degrees next to no light gets through, and the root is ill-conditioned.
            "density": abs(found["density"][k] / density - 1.0) if -v @ normal > np.cos(np.radians(75)) else 0.0,
            "exit": np.linalg.norm(found["exit"][k] - (p + lengths[0] * u)) / straight,
        }
        # The apparent point lies on the ray as it goes straight on.
        y = seen_from[k] - p
        errors["seen_from"] = np.linalg.norm(np.cross(y, u)) / straight
        for key, error in errors.items():
            worst[key] = max(worst[key], error)
    limits = dict(to_port=4e-7, inside=2e-6, water=4e-7, path=4e-7, transmission=2e-6, density=1e-5)
    limits |= dict(exit=1e-6, seen_from=1e-6)
    assert {key: value for key, value in worst.items() if value > limits[key]} == {}


def test_solid_angles_behind_a_window_are_those_of_the_contract(device):
    """Per area of a plane parallel to the window, 0.05 m of air and 0.01 m of glass of 1.52, water of 1.34."""
    port = make_flat_port(distance=0.05, thickness=0.01, index=(1.0, 1.52, 1.34), group_index=(1.0, 1.52, 1.34))
    x = np.array([[0, 0, 5], [1, 0, 5], [0, 3, 5], [-4.5, 0, 5], [1, 0, 1]], np.float32)
    (found, _) = launched(KERNELS["flat"][0], [port, x, np.zeros_like(x)], [Connection, wp.vec3], device)
    on_plane = found["density"] * -found["inside"][:, 2]
    assert on_plane == pytest.approx([0.0397481, 0.0374600, 0.0249011, 0.0157221, 0.2708027], rel=2e-6)


@pytest.mark.parametrize("kind", ["flat", "dome"])
def test_equal_indices_are_no_port(kind, device):
    options = (FLAT if kind == "flat" else DOME)["none"]
    x, o = points(options)
    (found, _) = launched(KERNELS[kind][0], [made(kind, options), x, o], [Connection, wp.vec3], device)
    y = x.astype(np.float64) - o
    r = np.linalg.norm(y, axis=1)
    assert found["density"] * r**2 == pytest.approx(1.0, rel=2e-6)
    assert found["path"] == pytest.approx(r, rel=3e-7)
    assert (found["transmission"] == 1.0).all() or found["transmission"] == pytest.approx(1.0, abs=1e-6)
    assert found["to_port"] == pytest.approx(-y / r[:, None], abs=3e-7)


@pytest.mark.parametrize(("kind", "name", "options"), CASES, ids=lambda value: value if isinstance(value, str) else "")
def test_rays_through_a_port_and_back(kind, name, options, device):
    port = made(kind, options)
    x, _ = points(options)
    rng = np.random.default_rng(3)
    aim = rng.uniform(-0.25, 0.25, x.shape) * options.get("radius", options.get("distance"))
    u = aim - x
    u = (u / np.linalg.norm(u, axis=1, keepdims=True)).astype(np.float32)
    found, back = launched(KERNELS[kind][1], [port, x, u], [PortRay, PortRay], device)
    passed = found["transmission"] > 0.0
    assert passed.sum() > 20
    faces, n, group = faces_of(options), options["index"][::-1], options["group_index"]
    for k in np.flatnonzero(passed):
        p = x[k].astype(np.float64)
        y, v, lengths, through = refraction.trace(faces, n, p, u[k] / np.linalg.norm(u[k].astype(np.float64)))
        met, last = refraction.meet_plane(y, v, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        size = np.linalg.norm(p) + np.linalg.norm(met)
        assert found["x"][k] == pytest.approx(met, abs=5e-6 * size)
        # The rounding of far positions, against a dome's radius.
        assert found["u"][k] == pytest.approx(v, abs=3e-6 + 3e-7 * size / options.get("radius", np.inf))
        assert found["water"][k] == pytest.approx(lengths[0], abs=5e-6 * size)
        assert found["path"][k] == pytest.approx((lengths[1] * group[1] + last * group[0]) / group[2], abs=5e-6 * size)
        assert found["transmission"][k] == pytest.approx(through, abs=1e-5)
        assert back["x"][k] == pytest.approx(p + lengths[0] * u[k], abs=1e-5 * size)
        assert back["u"][k] == pytest.approx(-u[k], abs=1e-5)
        assert back["path"][k] == pytest.approx(found["path"][k], abs=5e-6 * size)
        assert back["transmission"][k] == pytest.approx(found["transmission"][k], abs=1e-5)


def test_what_lies_behind_the_port_has_no_way(device):
    x = np.array([[0, 0, 0.03], [0.1, 0, 0.0599], [0, 0, -4.0]], np.float32)
    (found, _) = launched(
        KERNELS["flat"][0], [made("flat", FLAT["window"]), x, np.zeros_like(x)], [Connection, wp.vec3], device
    )
    assert not found["density"].any()
    # Beyond the critical angle water lets no light out.
    u = np.array([[0.8, 0.0, -0.6]], np.float32)
    (lost, _) = launched(KERNELS["flat"][1], [made("flat", FLAT["surface"]), u * -9, u], [PortRay, PortRay], device)
    assert lost["transmission"][0] == 0.0


@pytest.mark.parametrize(
    ("make", "changes", "text"),
    [
        (make_flat_port, dict(distance=0.0), "reaches through the port"),
        (make_flat_port, dict(distance=0.05, thickness=-1.0), "thickness = -1.0 is outside"),
        (make_flat_port, dict(distance=0.001, normal=TILT, aperture_radius=0.02), "reaches through the port"),
        (make_flat_port, dict(distance=0.05, index=(0.5, 1.5, 1.3)), r"index\[0\] = 0.5 is outside"),
        (make_dome_port, dict(radius=0.05, thickness=0.0, centre=(0.0, 0.0, 0.06)), "too far"),
    ],
)
def test_impossible_ports_are_named(make, changes, text):
    with pytest.raises(ArgumentError, match=text):
        make(**indices(AIR, GLASS, WATER) | changes)
