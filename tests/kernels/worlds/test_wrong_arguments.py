"""Wrong arguments of the cameras for simulators: errors that name argument and value, and no crash of the process."""

import dataclasses
import gc

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.meshes import mesh_of
from helpers.worlds import STILL, transforms

SMALL = sk.SpadConfig(width=8, height=6, bins=32, gate_distance=(0.5, 6.0), pulses=100, pulse_energy=1e-12)


LARGE = dataclasses.replace(SMALL, width=192, height=192, bins=64)


def poses(*rows):
    return transforms(rows, "cpu")


def triangle(last=2):
    return mesh_of([(0, 0, 3), (1, 0, 3), (0, 1, 3)], [0, 1, last])


def camera(cameras=1, **arguments):
    return sk.SpadCamera(SMALL, cameras, **{"frame": "optical"} | arguments, device="cpu")


def depths(cameras):
    return wp.zeros((cameras, 6, 8), dtype=float, device="cpu")


def boxes(**arguments):
    given = {"kind": ["plane", "box"], "size": [(0, 0, 0), (0.3, 0.2, 0.2)], "body": [-1, 0], "device": "cpu"}
    given |= {"local": [(0, 0, 4, 0, 0, 0, 1), STILL]} | arguments
    return sk.make_shapes(given.pop("kind"), given.pop("size"), **given)


def one_step(kind, shapes, camera_q, body_q):
    one = camera() if kind == "camera" else sk.SpadTracer(shapes, SMALL, photons=500, frame="optical")
    one.update(*([shapes] if kind == "camera" else []), camera_q, body_q)
    return one


@pytest.mark.parametrize("kind", ["camera", "tracer"])
def test_poses_of_a_first_step(kind):
    for row, text in (
        ((np.nan,) * 7, r"\[nan, .*\] is not finite"),
        ((np.inf, 0, 0, 0, 0, 0, 1), r"\[inf, .*\] is not finite"),
        ((0,) * 7, "has the quaternion .* of length 0; one of length 1 is needed"),
        ((0, 0, 0, 0, 0, 0, 2), "has the quaternion .* of length 2; one of length 1 is needed"),
    ):
        for name, pair in (("camera_q", (row, STILL)), ("body_q", (STILL, row))):
            with pytest.raises(sk.ArgumentError, match=rf"{name}\[0\].* {text}"):
                one_step(kind, boxes(), *map(poses, pair))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"kind": ["torus"] * 2}, "is not a list of plane, sphere"),
        ({"kind": ["mesh"] * 2}, r"mesh\[0\] = 0 is none"),
        ({"mesh": [-1, 0]}, r"mesh = -1 is outside"),
        ({"world": [3, 0]}, r"world\[0\] = 3 is not whole or outside \[-1, 0\]"),
        ({"visible": [True] * 3}, r"visible has shape \(3,\); \(2,\)"),
        ({"size": [(0, 0, 0), (-1, 1, 1)]}, r"size\[1\] = \[-1.0, 1.0, 1.0\] of a box is not finite and 0 or more"),
        ({"size": wp.full(2, wp.vec3(np.nan), device="cpu")}, r"size\[0\] = \[nan, .* of a plane is not finite"),
        ({"body": [-1, 2**31]}, "body is not an integer of 32 bits"),
        ({"local": [STILL, (0,) * 7]}, r"local\[1\] has the quaternion .* of length 0"),
        ({"world": [[0], [0, 1]]}, "world is list and not an array of numbers"),
        ({"kind": ["mesh"] * 2, "mesh": [12345] * 2}, r"mesh\[0\] is not the id of a wp.Mesh in meshes"),
        ({"kind": ["mesh"] * 2, "mesh": [triangle(9)] * 2}, r"mesh\[0\].indices\[2\] = 9 is outside \[0, 2\]"),
        ({"kind": ["mesh"] * 2, "mesh": [triangle()] * 2, "first_face": 99}, "reach beyond the 0 faces of textures"),
    ],
)
def test_shapes(arguments, text):
    with pytest.raises(sk.ArgumentError, match=text):
        boxes(**arguments)


BOX_ON_BODY_2 = sk.make_shapes(["box"], [(1, 1, 1)], body=[2], device="cpu")


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: sk.SpadConfig(gate_distance=(5.0, 2.0)), r"config.gate_distance\[1\] = 2.0 is outside \(5.0, inf\)"),
        (lambda: sk.SpadConfig(timing_sigma=1e3), "config.timing_sigma = 1000.0 s is .* bins"),
        (lambda: sk.SpadCamera(frame="usd", device="cpu"), "frame = 'usd' is not one of 'optical', 'opengl'"),
        (lambda: sk.SpadCamera(cameras=2, world=[0], device="cpu"), r"world has shape \(1,\); \(2,\)"),
        (lambda: sk.SpadTracer(boxes(worlds=2), SMALL, 3), "world = 2 is none of the 2 worlds"),
        (lambda: sk.SpadTracer(BOX_ON_BODY_2, SMALL, estimator="analog"), "estimator = 'analog' is not one of 'guid"),
        # Kernels would read beyond the arrays.
        (lambda: camera().update(BOX_ON_BODY_2, poses(STILL), None), "body_q has 0 poses; the shapes are on 3 bodies"),
        (lambda: camera().update(BOX_ON_BODY_2, poses(STILL), poses(STILL, STILL)), "body_q has 2 poses; the shapes"),
        (lambda: camera(world=[1]).update(boxes(), *[poses(STILL)] * 2), "world = 1 is none of the 1 worlds"),
        (lambda: camera().update_from_images(depths(2)), r"depth is a wp.array of float32, shape \(2, 6, 8\)"),
        # Arrays that no device holds.
        (lambda: camera(cameras=10**9), r"cameras x config.height x config.width = 48000000000 is outside"),
        (lambda: dataclasses.replace(SMALL, pulses=np.array(3.0)), r"config.pulses = array\(3.\) is not an integer"),
        (lambda: sk.SpadCamera(dataclasses.replace(SMALL, bins=8192), 4 * 10**7, device="cpu"), "need 1.26e.05 GB"),
        (lambda: sk.SpadTracer(boxes(), LARGE, oversampling=1024), "oversampling = 2415919104 is outside"),
        (lambda: sk.SpadTracer(boxes(visible=False), SMALL), "world 0 of camera 0 has no shapes"),
    ],
)
def test_errors_name_the_argument(call, text):
    with pytest.raises(sk.ArgumentError, match=text):
        call()


@pytest.mark.parametrize("kind", ["camera", "tracer"])
def test_a_mesh_lives_as_long_as_its_shapes(kind):
    mesh = triangle()
    image = sk.make_textures(np.zeros(1, int), np.zeros((1, 3, 2)), [np.ones((1, 1))], device="cpu")  # of the kernel
    options = {"mesh": [mesh.id], "meshes": [mesh], "first_face": [0], "textures": image}  # that others have compiled
    shapes = sk.make_shapes(["mesh"], [(1, 1, 1)], **options, device="cpu")
    del mesh
    gc.collect()
    assert np.nanmin(one_step(kind, shapes, poses(STILL), None).true_depth.numpy()) == pytest.approx(3.0)


def test_what_changes_in_place_to_something_that_there_is_not(device):
    """Worlds of cameras and kinds of shapes: nothing is seen there."""
    world = wp.zeros(1, dtype=int, device=device)
    shapes = sk.make_shapes(["plane"], [(0, 0, 0)], local=[(0, 0, 4, 0, 0, 0, 1)], device=device)
    one = sk.SpadCamera(SMALL, world=world, frame="optical", device=device)
    pose = wp.array([STILL], dtype=wp.transform, device=device)
    for there in (0, 7, -3):
        world.fill_(there)
        one.update(shapes, pose)
        assert np.isfinite(one.true_depth.numpy()).all() == (there == 0)
    world.zero_()
    shapes.table.kind.fill_(99)
    one.update(shapes, pose)
    assert np.isnan(one.true_depth.numpy()).all()
