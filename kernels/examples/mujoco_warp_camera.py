"""Single-photon cameras in a MuJoCo Warp simulation: a ball falls into murky water, in several worlds at once."""

import mujoco
import mujoco_warp as mjw
import warp as wp

import spadwarp_kernels as sk

SCENE = """<mujoco><option timestep="0.01"/><worldbody>
  <geom type="plane" size="0 0 1" rgba="0.5 0.5 0.5 1"/>
  <body pos="0 0 1.5"><freejoint/><geom type="sphere" size="0.3" rgba="0.8 0.7 0.2 1"/></body>
  <camera pos="0 -3 1" xyaxes="1 0 0 0 0.2 1" fovy="50"/>
</worldbody></mujoco>"""


def main(worlds=4, steps=60, device=None):
    """The depth images of the last step, `[worlds, height, width]`."""
    host = mujoco.MjModel.from_xml_string(SCENE)
    with wp.ScopedDevice(device):
        model, data = mjw.put_model(host), mjw.make_data(host, nworld=worlds)
        shapes = sk.mujoco_shapes(host, worlds)
        camera = sk.SpadCamera(sk.SpadConfig(width=80, height=60), worlds, frame="opengl")
        bodies = wp.empty(worlds * host.nbody, dtype=wp.transform)
        poses = wp.empty(worlds, dtype=wp.transform)
        for _ in range(steps):
            mjw.step(model, data)
            sk.write_poses(data.xpos, data.xquat, bodies)
            sk.write_poses(data.cam_xpos[:, 0], data.cam_xmat[:, 0], poses)
            camera.update(shapes, poses, bodies)
    return camera.depth


if __name__ == "__main__":
    depth = main().numpy()
    print(f"depth {depth.shape}, {depth[0, 30, 40]:.3f} m in the middle of the first image")
