"""Shapes and poses of Newton and MuJoCo, against the simulators' own rays."""

import dataclasses

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk

CONFIG = sk.SpadConfig(width=80, height=60, vertical_fov=0.948, absorption=0.0, scattering=0.0)
MEASURED = dataclasses.replace(CONFIG, dark_rate=0.0, pulse_energy=2e-11, pulses=200_000)


def looking(position, forward):
    """A pose in the frame "opengl": -z towards `forward`, +y up as far as the world's z goes."""
    back = -np.asarray(forward, float) / np.linalg.norm(forward)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(back, right), back], axis=1)
    return wp.transform(wp.vec3(*position), wp.quat_from_matrix(wp.mat33(*matrix.ravel())))


@pytest.mark.filterwarnings("default")  # those of the simulator
def test_depth_of_newtons_own_camera():
    newton = pytest.importorskip("newton")
    from newton.sensors import SensorCamera

    world = newton.ModelBuilder()
    adds = {
        "box": {"hx": 0.3, "hy": 0.2, "hz": 0.25},
        "sphere": {"radius": 0.3},
        "capsule": {"radius": 0.2, "half_height": 0.3},
        "cylinder": {"radius": 0.2, "half_height": 0.3},
        "cone": {"radius": 0.2, "half_height": 0.3},
        "ellipsoid": {"rx": 0.2, "ry": 0.3, "rz": 0.1},
        "mesh": {"mesh": newton.Mesh.create_box(0.2, 0.2, 0.3), "scale": (1.0, 0.5, 1.2)},
    }
    for k, (kind, sizes) in enumerate(adds.items()):
        place = wp.vec3(-0.9 + 0.6 * (k % 4), 0.9 * (k // 4), 1.0)
        body = world.add_body(xform=wp.transform(place, wp.quat_rpy(0.3 + k, 0.4, 0.2)))
        getattr(world, f"add_shape_{kind}")(body, **sizes)
    scene = newton.ModelBuilder()
    scene.replicate(world, 2)
    scene.add_ground_plane()
    model = scene.finalize(device="cpu")
    state = model.state()
    moved = state.body_q.numpy()
    moved[len(moved) // 2 :, 2] += 0.3  # the bodies of the second world
    state.body_q.assign(moved)
    model.bvh_refit_shapes(state)
    poses = wp.array([looking((0.0, -4.0, 1.5), (0.0, 4.0, -0.9))] * 2, dtype=wp.transform, device="cpu")

    rays = SensorCamera.compute_camera_rays_pinhole(80, 60, camera_fov=CONFIG.vertical_fov, device="cpu")
    sensor = SensorCamera(model)
    forward, along = (sensor.allocate_image_depth(2, 80, 60) for _ in range(2))
    normal = sensor.allocate_image_normal(2, 80, 60)
    sensor.update(state, poses, rays, depth_image=along, forward_depth_image=forward, normal_image=normal)
    theirs = forward.numpy()
    seen = theirs > 0.0

    camera = sk.SpadCamera(MEASURED, 2, device="cpu")
    camera.update(sk.newton_shapes(model, reflectance=0.3), poses, state.body_q)
    mine, measured = camera.true_depth.numpy().copy(), camera.depth.numpy().copy()
    own_normal = camera.normal.numpy().copy()
    assert mine.shape == theirs.shape and seen.mean() > 0.5
    assert np.mean(np.isfinite(mine) == seen) > 0.999
    both = seen & np.isfinite(mine)
    assert np.quantile(abs(mine - theirs)[both], 0.99) < 1e-3
    assert not np.allclose(mine[0], mine[1], equal_nan=True)  # the worlds differ
    near = both & (theirs < 8.0)
    assert abs(np.nanmedian((measured - theirs)[near])) < 1e-3  # what the detector makes of it, in clear water

    # Newton's images in place of our rays.
    camera.update_from_images(along, normal, 0.3, along_ray=True, camera_q=poses)
    assert np.quantile(abs(camera.true_depth.numpy() - theirs)[both], 0.99) < 1e-4
    assert np.median(np.sum(camera.normal.numpy() * own_normal, axis=-1)[both]) > 0.9999


def test_colours_are_the_reflectance_at_532_nm():
    newton = pytest.importorskip("newton")
    scene = newton.ModelBuilder()
    body = scene.add_body(xform=wp.transform((0.0, 0.0, 1.0), wp.quat_identity()))
    scene.add_shape_sphere(body, radius=0.3, color=(1.0, 0.5, 0.0))
    shapes = sk.newton_shapes(scene.finalize(device="cpu"))
    assert shapes.table.reflectance.numpy() == pytest.approx([0.2140], abs=1e-3)  # of sRGB 0.5


MJCF = """<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.6 0 0  0 0.5 0  0 0 0.4"/>
    <hfield name="hills" nrow="3" ncol="3" size="2 4 0.5 0.001" elevation="0 1 0  0 2 0  0 0 0"/>
    <material name="paint" rgba="0.1 0.6 0.1 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="2 3 1" pos="0 0 -1"/>
    <geom type="hfield" hfield="hills" pos="0 4 -1"/>
    <body pos="-0.9 0 0.2" euler="20 30 10"><freejoint/><geom type="box" size="0.3 0.2 0.1" material="paint"/></body>
    <body pos="-0.3 0 0.2" euler="20 30 10"><freejoint/><geom type="capsule" size="0.1 0.3"/></body>
    <body pos="0.3 0 0.2" euler="70 30 10"><freejoint/><geom type="cylinder" size="0.2 0.2" pos="0 0 0.1"/></body>
    <body pos="0.9 0 0.2" euler="20 30 10"><freejoint/><geom type="ellipsoid" size="0.3 0.1 0.2"/></body>
    <body pos="0 0.6 0.7" euler="20 30 10"><freejoint/><geom type="mesh" mesh="wedge"/>
      <geom type="sphere" size="0.9" group="4"/></body>
    <camera pos="0 -3 1" xyaxes="1 0 0 0 0.2 1"/>
  </worldbody>
</mujoco>"""


def test_depth_of_mujocos_own_rays():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    shapes = sk.mujoco_shapes(model, 2, device="cpu")
    camera = sk.SpadCamera(MEASURED, 2, device="cpu")

    def worlds(array, dtype):
        return wp.array(np.stack([array, array]).astype(np.float32), dtype=dtype, device="cpu")

    bodies = wp.empty(2 * model.nbody, dtype=wp.transform, device="cpu")
    poses = wp.empty(2, dtype=wp.transform, device="cpu")
    sk.write_poses(worlds(data.xpos, wp.vec3), worlds(data.xquat, wp.quat), bodies)
    cameras = worlds(data.cam_xpos, wp.vec3), worlds(data.cam_xmat.reshape(-1, 3, 3), wp.mat33)
    sk.write_poses(cameras[0][:, 0], cameras[1][:, 0], poses)
    camera.update(shapes, poses, bodies)
    mine = camera.true_depth.numpy()
    assert np.array_equal(mine[0], mine[1], equal_nan=True)

    view = CONFIG.lines_of_sight()
    rays = (view * (1.0, -1.0, -1.0)) @ data.cam_xmat.reshape(3, 3).T
    geom = np.zeros(1, np.int32)
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    theirs = np.array([mujoco.mj_ray(model, data, data.cam_xpos[0], ray, groups, 1, -1, geom) for ray in rays])
    theirs = np.where(theirs < 0.0, np.nan, theirs * view[:, 2]).reshape(60, 80)
    assert np.mean(np.isfinite(theirs) == np.isfinite(mine[0])) > 0.997
    assert np.nanquantile(abs(theirs - mine[0]), 0.99) < 1e-3
    assert np.isfinite(theirs).mean() > 0.3
    assert abs(np.nanmedian(camera.depth.numpy()[0] - theirs)) < 1e-3  # what the detector makes of it, in clear water
    assert shapes.table.reflectance.numpy()[:3] == pytest.approx([0.2140, 0.2140, 0.3185], abs=1e-3)  # sRGB 0.5 and 0.6
