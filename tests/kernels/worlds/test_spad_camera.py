"""SpadCamera: what it sees, the law of its counts, and a step that stays on the device."""

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import on_device
from helpers.worlds import STILL, square, transforms

CLEAR = {"absorption": 0.0, "scattering": 0.0}
SMALL = {"width": 24, "height": 18}


BODIES = [(-0.8, 0, 2, 0, 0, 0, 1), (0, 0.3, 2.5, 0, 0, 0, 1)]


def room(device):
    """A wall at z = 4 in both worlds, a ball on body w in world w, a square with an image in the second."""
    mesh, uv = square(device)
    return sk.make_shapes(
        ["plane", "sphere", "sphere", "mesh"],
        [(0, 0, 0), (0.4, 0, 0), (0.4, 0, 0), (1, 1, 1)],
        body=[-1, 0, 1, -1],
        local=[(0, 0, 4, 0, 0, 0, 1), STILL, STILL, (1, 0, 3, 0, 0, 0, 1)],
        mesh=[None, None, None, mesh],
        reflectance=[0.5, 0.3, 0.3, 0.8],
        world=[-1, 0, 1, 1],
        worlds=2,
        first_face=[-1, -1, -1, 0],
        textures=sk.make_textures(np.zeros(2, int), uv, [np.array([[0.25, 1.0]])], device=device),
        device=device,
    )


def seen(device, config):
    """A camera in each world, which has looked at the room."""
    camera = sk.SpadCamera(config, 2, frame="optical", device=device)
    camera.update(room(device), transforms([STILL] * 2, device), transforms(BODIES, device))
    return camera


def facing(device, z, **options):
    """A camera that was given images of depths z of faces towards it."""
    camera = sk.SpadCamera(sk.SpadConfig(**SMALL, **options), device=device)
    normal = np.tile(np.float32([0, 0, -1]), (1, 18, 24, 1))
    camera.update_from_images(on_device(z, device), on_device(normal, device, wp.vec3), 0.4)
    return camera


def test_worlds_bodies_and_reflectance(device):
    """Each camera sees its world and what stands in all; bodies move; images multiply the reflectance."""
    camera = seen(device, sk.SpadConfig(width=120, height=90, **CLEAR))
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
    camera.distance.assign(camera.true_distance)
    camera.point_cloud(points, frame="forward_left_up")
    floor = points.numpy()[0, -3:].reshape(-1, 3)
    assert floor[:, 2] == pytest.approx(-1.0, abs=1e-4) and (floor[:, 0] > 0).all()


@pytest.mark.slow
def test_images_of_the_simulator(device):
    """Depth, normals and reflectance from elsewhere give the rates of the camera's own rays."""
    config = sk.SpadConfig(**SMALL)
    camera = seen(device, config)
    depth, normal, reflectance = (wp.clone(one) for one in (camera.true_depth, camera.normal, camera.reflectance))
    rates = camera.rates.numpy()
    camera.update_from_images(depth, normal, reflectance)
    # A depth's last bit is 1.7e-4 of the rate in the tail of a pulse, and rounding differs by device.
    assert camera.rates.numpy() == pytest.approx(rates, rel=4e-4, abs=1e-12)
    assert camera.rates.numpy() == pytest.approx(rates, rel=1e-5, abs=3e-5 * float(rates.max()))
    view = config.lines_of_sight()[:, 2].reshape(18, 24)
    along, back = on_device(depth.numpy() / view, device), on_device(-normal.numpy(), device, wp.vec3)  # either side
    camera.update_from_images(along, back, reflectance, along_ray=True)
    assert camera.rates.numpy() == pytest.approx(rates, rel=4e-4, abs=1e-9)
    camera.update_from_images(depth, None, reflectance)
    slopes = np.sum(camera.normal.numpy() * normal.numpy(), axis=-1)
    assert np.median(slopes) > 0.9999 and (slopes > 0).all()
    # Normals in the world's frame: a camera turned by half a circle about its axis.
    turned = sk.SpadCamera(config, 2, frame="optical", device=device)
    world = on_device(normal.numpy() * (-1, -1, 1), device, wp.vec3)
    turned.update_from_images(depth, world, reflectance, camera_q=transforms([(0, 0, 0, 0, 0, 1, 0)] * 2, device))
    assert turned.normal.numpy() == pytest.approx(normal.numpy(), abs=1e-6)


def test_rates_are_those_of_the_analytic_model(device):
    """Over the bins: the signal of `signal_map`, the backscatter of `single_scatter_table`, the dark counts."""
    z = np.linspace(2.0, 5.0, 18 * 24, dtype=np.float32).reshape(1, 18, 24)
    gate = {"gate_distance": (0.5, 8.0), "bins": 200}
    camera = facing(device, z, **gate, dark_rate=5e4)
    config, rates = camera.config, camera.rates.numpy().reshape(-1, 200).astype(float)
    view = config.lines_of_sight()
    distance = on_device(z.ravel() / view[:, 2], device, wp.float64)
    view, normal = on_device(view, device, wp.vec3d), on_device(np.tile([0, 0, -1.0], (len(view), 1)), device, wp.vec3d)
    reflectance = wp.full(distance.size, 0.4, dtype=wp.float64, device=device)
    signal, arrival = (one.numpy() for one in sk.signal_map(config.lidar(), view, distance, normal, reflectance))
    phase = sk.henyey_greenstein_density(1.0 - np.cos(np.linspace(0.0, np.pi, 4097)), config.anisotropy)
    phase = on_device(phase, device, wp.float64)
    back = sk.single_scatter_table(config.lidar(), phase, view, distance)[2].numpy()
    dark = config.dark_rate * 2 * 7.5 / config.speed
    # The response carries what arrives at the gate's start over it, in both directions.
    assert rates.sum(axis=1) == pytest.approx(signal + back + dark, rel=0.03)
    assert rates.sum(axis=1).sum() == pytest.approx((signal + back + dark).sum(), rel=5e-3)
    # Without water: the mean and spread of the histogram are the arrival time and the response.
    rates = facing(device, z, **gate, dark_rate=0.0, **CLEAR).rates.numpy().reshape(-1, 200).astype(float)
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
    z = np.random.default_rng(3).uniform(1.0, 3.0, (1, 18, 24)).astype(np.float32)
    options = {"pulses": 100_000, "pulse_energy": 2e-12, "absorption": 0.02, "scattering": 0.0}
    error = facing(device, z, method=method, **options).depth.numpy() - z
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
