"""SpadCamera: what it sees, the law of its counts, and a step that stays on the device."""

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.worlds import transforms

CLEAR = {"absorption": 0.0, "scattering": 0.0}
SMALL = {"width": 24, "height": 18}


def room(device, worlds=2):
    """A wall at z = 4 in all worlds, a ball on body w in world w, a textured square in the last."""
    square = np.array([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], np.float32)
    faces = wp.array([0, 1, 2, 0, 2, 3], dtype=int, device=device)
    mesh = wp.Mesh(wp.array(square, dtype=wp.vec3, device=device), faces)
    uv = (square[:, :2] + 0.5)[[[0, 1, 2], [0, 2, 3]]]
    textures = sk.make_textures(np.zeros(2, int), uv, [np.array([[0.25, 1.0]])], device=device)
    return sk.make_shapes(
        ["plane", *["sphere"] * worlds, "mesh"],
        [(0, 0, 0), *[(0.4, 0, 0)] * worlds, (1, 1, 1)],
        body=[-1, *range(worlds), -1],
        local=[(0, 0, 4, 0, 0, 0, 1), *[(0, 0, 0, 0, 0, 0, 1)] * worlds, (1, 0, 3, 0, 0, 0, 1)],
        mesh=[None, *[None] * worlds, mesh],
        reflectance=[0.5, *[0.3] * worlds, 0.8],
        world=[-1, *range(worlds), worlds - 1],
        worlds=worlds,
        first_face=[-1, *[-1] * worlds, 0],
        textures=textures,
        device=device,
    )


def test_worlds_bodies_and_reflectance(device):
    """Each camera sees its world and what stands in all; bodies move; images multiply the reflectance."""
    camera = sk.SpadCamera(sk.SpadConfig(width=120, height=90, **CLEAR), 2, device=device)
    poses = transforms([(0, 0, 0, 0, 0, 0, 1)] * 2, device)
    camera.update(room(device), poses, transforms([(-0.8, 0, 2, 0, 0, 0, 1), (0, 0.3, 2.5, 0, 0, 0, 1)], device))
    depth, reflectance = camera.true_depth.numpy(), camera.reflectance.numpy()
    assert depth[:, 0, 0] == pytest.approx(4.0, rel=1e-6)
    tangent = camera.config.pixel_tangent

    def at(world, x, y, z):
        return world, int(round(y / z / tangent + 44.5)), int(round(x / z / tangent + 59.5))

    assert depth[at(0, -0.8, 0, 2)] == pytest.approx(1.6, abs=0.07)  # seen from the side
    assert depth[at(1, 0, 0.3, 2.5)] == pytest.approx(2.1, abs=0.02)
    assert depth[at(0, 0, 0.3, 2.5)] == depth[at(1, -0.8, 0, 2)] == pytest.approx(4.0)
    assert reflectance[0, 0, 0] == 0.5 and reflectance[at(0, -0.8, 0, 2)] == pytest.approx(0.3)
    left, right = reflectance[at(1, 0.75, 0, 3)], reflectance[at(1, 1.25, 0, 3)]
    assert (left, right) == (pytest.approx(0.2, abs=0.1), pytest.approx(0.8, abs=0.1))  # 0.8 x (0.25, 1)
    assert reflectance[at(0, 1, 0, 3)] == 0.5
    normal = camera.normal.numpy()
    assert normal[0, 0, 0] == pytest.approx([0, 0, -1])
    assert np.linalg.norm(normal, axis=-1) == pytest.approx(1.0, abs=1e-5)


def test_frames_name_one_pose(device):
    """A camera at (1, 2, 0) that looks along world +x with world +z up, in three conventions."""
    columns = {  # the camera's axes in the world
        "optical": [(0, -1, 0), (0, 0, -1), (1, 0, 0)],
        "opengl": [(0, -1, 0), (0, 0, 1), (-1, 0, 0)],
        "forward_left_up": [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
    }
    shapes = sk.make_shapes(
        ["plane", "box"],
        [(0, 0, 0), (0.3, 0.2, 0.1)],
        local=[(0, 0, -1, 0, 0, 0, 1), (4, 2.6, 0.2, 0, 0, 0, 1)],
        device=device,
    )
    images = []
    for frame, axes in columns.items():
        turn = wp.quat_from_matrix(wp.mat33(*np.array(axes, float).T.ravel()))
        camera = sk.SpadCamera(sk.SpadConfig(width=60, height=40, **CLEAR), frame=frame, device=device)
        camera.update(shapes, transforms([(1, 2, 0, *turn)], device))
        images.append(camera.true_depth.numpy()[0])
    for image in images[1:]:
        assert np.allclose(image, images[0], rtol=1e-5, equal_nan=True)
    image = images[0]
    assert np.isnan(image[:15]).all(where=image[:15] > 5) and np.isfinite(image[-5:]).all()  # the floor is below
    row, column = np.argwhere(np.abs(image - 2.7) < 1e-3).mean(axis=0)
    assert row < 19.5 and column < 29.5  # the box is above and to the left
    points = wp.empty((1, 40, 60), dtype=wp.vec3, device=device)
    camera.depth.assign(images[0][None])
    camera.point_cloud(points, frame="forward_left_up")
    floor = points.numpy()[0, -3:].reshape(-1, 3)
    assert floor[:, 2] == pytest.approx(-1.0, abs=1e-4) and (floor[:, 0] > 0).all()


def test_images_of_the_simulator(device):
    """Depth, normals and reflectance from elsewhere give the rates of the camera's own rays."""
    config = sk.SpadConfig(**SMALL)
    camera = sk.SpadCamera(config, 2, device=device)
    poses = transforms([(0, 0, 0, 0, 0, 0, 1)] * 2, device)
    camera.update(room(device), poses, transforms([(-0.8, 0, 2, 0, 0, 0, 1), (0, 0.3, 2.5, 0, 0, 0, 1)], device))
    depth, normal, reflectance = (wp.clone(one) for one in (camera.true_depth, camera.normal, camera.reflectance))
    rates = camera.rates.numpy()
    camera.update_from_images(depth, normal, reflectance)
    assert camera.rates.numpy() == pytest.approx(rates, rel=1e-5, abs=1e-12)  # normals are normalised anew
    view = config.lines_of_sight()[:, 2].reshape(18, 24)
    along = wp.array((depth.numpy() / view).astype(np.float32), device=device)
    back = wp.array(-normal.numpy(), dtype=wp.vec3, device=device)  # either side
    camera.update_from_images(along, back, reflectance, along_ray=True)
    assert camera.rates.numpy() == pytest.approx(rates, rel=1e-4, abs=1e-9)
    camera.update_from_images(depth, None, reflectance)
    slopes = np.sum(camera.normal.numpy() * normal.numpy(), axis=-1)
    assert np.median(slopes) > 0.9999 and (slopes > 0).all()
    # Normals in the world's frame: a camera turned by half a circle about its axis.
    turned = sk.SpadCamera(config, 2, device=device)
    world = wp.array(normal.numpy() * (-1, -1, 1), dtype=wp.vec3, device=device)
    turned.update_from_images(depth, world, reflectance, camera_q=transforms([(0, 0, 0, 0, 0, 1, 0)] * 2, device))
    assert turned.normal.numpy() == pytest.approx(normal.numpy(), abs=1e-6)


def test_rates_are_those_of_the_analytic_model(device):
    """Over the bins: the signal of `signal_map`, the backscatter of `single_scatter_table`, the dark counts."""
    config = sk.SpadConfig(**SMALL, gate=(0.5, 8.0), dark_rate=5e4, bins=200)
    camera = sk.SpadCamera(config, device=device)
    z = np.linspace(2.0, 5.0, 18 * 24, dtype=np.float32).reshape(1, 18, 24)
    normal = np.zeros((1, 18, 24, 3), np.float32)
    normal[..., 2] = -1.0
    arrays = wp.array(z, device=device), wp.array(normal, dtype=wp.vec3, device=device)
    camera.update_from_images(*arrays, 0.4)
    rates = camera.rates.numpy().reshape(-1, 200).astype(float)
    view = config.lines_of_sight()
    distance = z.ravel() / view[:, 2]
    view_d = wp.array(view, dtype=wp.vec3d, device=device)
    distance_d = wp.array(distance, dtype=wp.float64, device=device)
    normal_d = wp.array(normal.reshape(-1, 3).astype(float), dtype=wp.vec3d, device=device)
    reflectance = wp.full(distance.size, 0.4, dtype=wp.float64, device=device)
    signal, arrival = (one.numpy() for one in sk.signal_map(config.lidar(), view_d, distance_d, normal_d, reflectance))
    phase = wp.array(config.phase_table(), dtype=wp.float64, device=device)
    back = sk.single_scatter_table(config.lidar(), phase, view_d, distance_d)[2].numpy()
    dark = config.dark_rate * 2 * 7.5 / config.speed
    # The response carries what arrives at the gate's start over it, in both directions.
    assert rates.sum(axis=1) == pytest.approx(signal + back + dark, rel=0.03)
    assert rates.sum(axis=1).sum() == pytest.approx((signal + back + dark).sum(), rel=5e-3)
    # Without water: the mean and spread of the histogram are the arrival time and the response.
    camera = sk.SpadCamera(sk.SpadConfig(**SMALL, gate=(0.5, 8.0), bins=200, dark_rate=0.0, **CLEAR), device=device)
    camera.update_from_images(*arrays, 0.4)
    rates = camera.rates.numpy().reshape(-1, 200).astype(float)
    path = 1.0 + (np.arange(200) + 0.5) * config.bin_path
    mean = rates @ path / rates.sum(axis=1)
    assert mean == pytest.approx(arrival * config.speed, abs=2e-4)
    spread = np.sqrt(rates @ path**2 / rates.sum(axis=1) - mean**2)
    width = config.timing_sigma * config.speed
    assert spread == pytest.approx(np.sqrt(width**2 + config.bin_path**2 / 12), rel=0.01)


def test_counts_follow_the_law_of_the_first_photon(device):
    """P(no count in a pulse) = exp(-sum of the rates), over frames; the counts are the sum of the histogram."""
    config = sk.SpadConfig(**SMALL, pulses=400, pulse_energy=5e-9, bins=64)
    camera = sk.SpadCamera(config, device=device)
    depth = wp.full((1, 18, 24), 3.0, dtype=float, device=device)
    total, frames = np.zeros((18, 24)), 60
    for _ in range(frames):
        camera.update_from_images(depth)
        assert np.array_equal(camera.counts.numpy(), camera.histogram.numpy().sum(axis=-1))
        total += camera.counts.numpy()[0]
    p = 1.0 - np.exp(-camera.rates.numpy()[0].sum(axis=-1, dtype=float))
    assert 0.1 < np.median(p) < 0.99  # pile-up matters
    z = (total - frames * 400 * p) / np.sqrt(frames * 400 * p * (1 - p))
    assert abs(z.mean()) < 5 / np.sqrt(z.size) and z.std() == pytest.approx(1.0, abs=0.2)
    assert camera.step.numpy()[0] == frames


@pytest.mark.parametrize("method", ["centroid", "matched", "likelihood"])
def test_depth_in_clear_water_has_no_offset(method, device):
    config = sk.SpadConfig(**SMALL, method=method, pulses=100_000, pulse_energy=2e-12, absorption=0.02, scattering=0.0)
    camera = sk.SpadCamera(config, device=device)
    z = np.random.default_rng(3).uniform(1.0, 3.0, (1, 18, 24)).astype(np.float32)
    normal = wp.array(
        np.broadcast_to([0.0, 0.0, -1.0], (1, 18, 24, 3)).astype(np.float32), dtype=wp.vec3, device=device
    )
    camera.update_from_images(wp.array(z, device=device), normal, 0.5)
    error = camera.depth.numpy() - z
    assert np.isfinite(error).all()
    assert abs(np.median(error)) < 1e-3 and np.median(abs(error)) < 5e-3


def test_a_step_depends_on_the_seed_and_its_number(device):
    depth = wp.full((1, 18, 24), 3.0, dtype=float, device=device)

    def frame(seed, number):
        camera = sk.SpadCamera(sk.SpadConfig(**SMALL, seed=seed), device=device)
        camera.step.fill_(number)
        camera.update_from_images(depth)
        return camera.histogram.numpy()

    assert np.array_equal(frame(1, 7), frame(1, 7))
    assert not np.array_equal(frame(1, 7), frame(1, 8)) and not np.array_equal(frame(1, 7), frame(2, 7))
