"""Cameras as robots have them: what a caller chooses, worlds that differ, scanners, mounts, and what a depth says."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.worlds import STILL, transforms

CONFIG = sk.SpadConfig(width=24, height=18, bins=64, gate_distance=(0.5, 6.0), pulses=2000, min_significance=2.0)
WALL = (0, 0, 3, 0, 0, 0, 1)


def wall(device, worlds=1, **options):
    options |= {"local": [WALL], "worlds": worlds, "reflectance": 0.4}
    return sk.make_shapes(["plane"], [(0, 0, 0)], device=device, **options)


def look(config, device, cameras=1, poses=None, **options):
    """A camera that has seen a wall at z = 3."""
    camera = sk.SpadCamera(config, cameras, frame="optical", device=device, **options)
    camera.update(wall(device, cameras), transforms(poses or [STILL] * cameras, device))
    return camera


@pytest.mark.slow
@pytest.mark.parametrize("method", ["centroid", "matched", "likelihood"])
def test_outputs_are_chosen(method, device):
    """A depth without stored bins is that of a camera that stores them."""
    config = dataclasses.replace(CONFIG, method=method)
    full, lean = look(config, device), look(config, device, outputs=("depth",))
    for name in ("depth", "distance", "significance", "status", "counts"):
        np.testing.assert_array_equal(getattr(full, name).numpy(), getattr(lean, name).numpy())
    assert lean.histogram.size == lean.rates.size == 0
    counted = look(config, device, outputs=("histogram",))
    np.testing.assert_array_equal(counted.histogram.numpy(), full.histogram.numpy())
    assert np.isnan(counted.depth.numpy()).all()


def test_worlds_that_differ(device):
    """Each world is that of a camera configured for it; water to 1 %, as the blur is that of the config's."""
    values = {
        "absorption": [0.1, 0.3],
        "scattering": [0.2, 0.6],
        "pulse_energy": [2e-9, 5e-9],
        "dark_rate": [1e3, 1e5],
        "pulses": [2000, 500],
        "gate_delay": [0.0, 1.03],
    }
    camera = look(CONFIG, device, 2, by_world=values)
    for world in range(2):
        one = {name: value[world] for name, value in values.items()}
        delay = one.pop("gate_delay")
        config = dataclasses.replace(CONFIG, **one, gate_distance=(0.5 + delay, 6.0 + delay))
        alone = look(config, device)
        rates, theirs = camera.rates.numpy()[world], alone.rates.numpy()[0]
        # The first bin of a later gate has what the response carries over its start.
        assert rates[..., 1:] == pytest.approx(theirs[..., 1:], rel=0.01 if world else 1e-6, abs=1e-9)
        assert np.nanmedian(camera.depth.numpy()[world]) == pytest.approx(3.0, abs=0.01)
        found, alone_found = (np.isfinite(each).mean() for each in (camera.depth.numpy()[world], alone.depth.numpy()))
        assert found == pytest.approx(alone_found, abs=0.1) and found > 0.5
        assert camera.counts.numpy()[world].mean() == pytest.approx(alone.counts.numpy().mean(), rel=0.02)
    with pytest.raises(sk.ArgumentError, match=r"by_world = 'water' is not one of 'absorption'"):
        look(CONFIG, device, by_world={"water": [0.1]})
    with pytest.raises(sk.ArgumentError, match=r"by_world\['gate_delay'\]\[0\] = 9 is outside \[0, 5.5\]"):
        look(CONFIG, device, by_world={"gate_delay": [9.0]})


@pytest.mark.parametrize("method", ["centroid", "likelihood"])
def test_false_alarms_of_worlds_that_differ(method, device):
    """Empty water, of which each world has its own: one pixel in a hundred, from the known background of its world."""
    water = {"absorption": [0.05, 0.1, 0.2, 0.4], "scattering": [0.1, 0.2, 0.5, 1.0], "pulses": [500, 1000, 2000, 4000]}
    config = dataclasses.replace(CONFIG, width=48, height=36, method=method)
    camera = sk.SpadCamera(config, 4, by_world=water, outputs=("depth",), device=device)
    camera.update_from_images(wp.full(camera.depth.shape, wp.nan, dtype=float, device=device))
    found = np.isfinite(camera.depth.numpy())
    assert found.sum() == pytest.approx(0.01 * found.size, abs=4 * math.sqrt(0.01 * found.size))
    assert (camera.status.numpy() == sk.CAMERA_STATUS.index("no_return")).sum() == (~found).sum()


@pytest.mark.slow
def test_traced_water_is_no_target(device):
    """Multiple scattering in water of four mean free paths, with nothing behind it: the stated false alarms."""
    shapes = sk.make_shapes(["plane"], [(0.1, 0.1, 0)], local=[(0, 0, -5, 0, 0, 0, 1)], frame="optical", device=device)
    config = dataclasses.replace(CONFIG, scattering=1.0, pulse_energy=2e-8)
    tracer = sk.SpadTracer(shapes, config, photons=20_000)
    found, pixels = 0, 0
    for _ in range(4):
        tracer.update(transforms([STILL], device))
        found, pixels = found + np.isfinite(tracer.depth.numpy()).sum(), pixels + tracer.depth.size
    assert tracer.counts.numpy().mean() > 20
    assert found == pytest.approx(0.01 * pixels, abs=4 * math.sqrt(0.01 * pixels))


def test_fields_of_view(device):
    """One image, described in four ways; a matrix may have pixels that are not square and a centre elsewhere."""
    k = CONFIG.intrinsics
    tall = 2.0 * math.atan(9.0 / k[1, 1])
    for given in ({"vertical_fov": tall}, {"camera_matrix": k.tolist()}, {"pixel_fov": 2.0 * math.atan(0.5 / k[0, 0])}):
        config = dataclasses.replace(CONFIG, **given)
        assert config.lines_of_sight() == pytest.approx(CONFIG.lines_of_sight(), abs=1e-12)
        assert config.half_angle == pytest.approx(CONFIG.half_angle)
    matrix = [(20.0, 0.0, 8.0), (0.0, 30.0, 10.0), (0.0, 0.0, 1.0)]
    camera = look(dataclasses.replace(CONFIG, camera_matrix=matrix), device)
    np.testing.assert_array_equal(camera.camera_matrix, matrix)
    rays = camera.true_distance.numpy()[0] / 3.0
    row, column = np.mgrid[:18, :24]
    assert rays == pytest.approx(np.sqrt(1 + ((column - 8) / 20) ** 2 + ((row - 10) / 30) ** 2), rel=1e-5)
    with pytest.raises(sk.ArgumentError, match=r"config\.horizontal_fov and config\.vertical_fov: only one"):
        sk.SpadConfig(horizontal_fov=1.0, vertical_fov=1.0)
    with pytest.raises(sk.ArgumentError, match=r"config.camera_matrix has shape \(1, 1\)"):
        sk.SpadConfig(camera_matrix=[[1.0]])


def test_frames_are_said(device):
    """By the shapes or by the camera, by both alike, and never by neither."""
    poses = transforms([STILL], device)
    with pytest.raises(sk.ArgumentError, match="frame is not given: say which of optical, opengl"):
        sk.SpadCamera(CONFIG, device=device).update(wall(device), poses)
    with pytest.raises(sk.ArgumentError, match="frame = 'optical'; the poses of cameras of these shapes are 'opengl'"):
        sk.SpadCamera(CONFIG, frame="optical", device=device).update(wall(device, frame="opengl"), poses)
    camera = sk.SpadCamera(CONFIG, device=device)
    camera.update(wall(device, frame="opengl"), poses)  # looks away from the wall
    assert np.isnan(camera.true_depth.numpy()).all()


def test_a_camera_on_a_body(device):
    """Its pose is the body's and its own on it."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.3)
    body, offset = wp.transform(wp.vec3(0.2, 0.0, -1.0), turn), wp.transform(wp.vec3(0.0, 0.1, 0.5), turn)
    free = look(CONFIG, device, poses=[tuple(body * offset)])
    camera = sk.SpadCamera(CONFIG, frame="optical", body=1, offset=tuple(offset), device=device)
    camera.update(wall(device), body_q=transforms([STILL, tuple(body)], device))
    np.testing.assert_allclose(camera.true_depth.numpy(), free.true_depth.numpy(), rtol=1e-5)
    with pytest.raises(sk.ArgumentError, match="camera_q: cameras on a body have"):
        camera.update(wall(device), transforms([STILL], device))
    with pytest.raises(sk.ArgumentError, match="body_q has 1 poses; a camera is on body 1"):
        camera.update(wall(device), body_q=transforms([STILL], device))


def test_worlds_that_are_updated(device):
    """A mask and a period leave the images of the other worlds as they are."""
    camera = sk.SpadCamera(CONFIG, 2, frame="optical", update_period=0.1, device=device)
    shapes, poses = wall(device, 2), transforms([STILL] * 2, device)
    seen = []
    for step, active in enumerate([None, None, [True, False], None]):
        mask = None if active is None else wp.array(active, dtype=wp.bool, device=device)
        camera.update(shapes, poses, active=mask, dt=0.05)
        seen.append(camera.histogram.numpy().copy())
        assert camera.step.numpy()[0] == step + 1
    new = [[not np.array_equal(a[world], b[world]) for world in range(2)] for a, b in itertools.pairwise(seen)]
    assert new == [[False, False], [True, False], [False, True]]
    camera = sk.SpadCamera(CONFIG, 2, frame="optical", device=device)
    camera.update(shapes, poses, active=wp.array([False, True], dtype=wp.bool, device=device))
    assert [one.any() for one in camera.counts.numpy()] == [False, True]
    camera.update(shapes, poses)
    assert all(one.any() for one in camera.counts.numpy())


def test_rays_of_a_scanner(device):
    """A full turn at three elevations in a ball: the light of one ray is that of all, and distances are its radius."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 40, endpoint=False), [-0.4, 0.0, 0.4])
    rays = np.stack([np.sin(azimuth) * np.cos(elevation), -np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], -1)
    ball = sk.make_shapes(["sphere"], [(3.0, 0, 0)], reflectance=0.4, frame="optical", device=device)
    config = sk.SpadConfig(width=40, height=3, pixel_fov=0.01, laser_half_angle=0.02, pulses=2000, pulse_energy=1e-12)
    camera = sk.SpadCamera(config, rays=rays, device=device)
    camera.update(ball, transforms([STILL], device))
    assert camera.true_distance.numpy() == pytest.approx(3.0, rel=1e-5)
    assert camera.true_depth.numpy() == pytest.approx(3.0 * rays[None, ..., 2], abs=1e-4)
    rates = camera.rates.numpy()[0].reshape(-1, config.bins)
    np.testing.assert_allclose(rates, np.broadcast_to(rates[0], rates.shape), rtol=1e-3, atol=1e-12)
    assert np.median(camera.distance.numpy()) == pytest.approx(3.0, abs=0.01)
    points = wp.empty(camera.depth.shape, dtype=wp.vec3, device=device)
    camera.point_cloud(points)
    assert np.median(np.linalg.norm(points.numpy(), axis=-1)) == pytest.approx(3.0, abs=0.01)


def test_status(device):
    """A target; too much light; a wall behind the gate; nothing."""
    clear = dataclasses.replace(CONFIG, absorption=0.0, scattering=0.0, dark_rate=0.0)
    cases = {
        "target": dataclasses.replace(clear, pulse_energy=1e-12),
        "saturated": dataclasses.replace(clear, pulse_energy=1e-6),
        "outside_gate": dataclasses.replace(clear, gate_distance=(0.5, 2.0)),
        "no_return": dataclasses.replace(clear, pulse_energy=0.0),
    }
    for word, config in cases.items():
        camera = look(config, device)
        assert (camera.status.numpy() == sk.CAMERA_STATUS.index(word)).mean() > 0.95, word
        seen = float(word in ("target", "saturated"))
        assert np.isfinite(camera.depth.numpy()).mean() == pytest.approx(seen, abs=0.05)
    assert set(camera.output) >= {"distance_to_image_plane", "distance_to_camera"}
