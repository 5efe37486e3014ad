"""Single-photon cameras in a MuJoCo Warp simulation: on a falling box over a ball in murky water, in many worlds."""

import mujoco
import mujoco_warp as mjw
import warp as wp

import spadwarp_kernels as sk

SCENE = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="0 0 1"/>
  <geom type="sphere" size="0.3" pos="0 0.3 0.3"/>
  <body pos="0 0 3"><freejoint/><geom type="box" size="0.3 0.2 0.2"/></body></worldbody></mujoco>"""


def main(worlds=4, steps=20, device=None):
    """The camera after the last step; its images are `[worlds, height, width]`."""
    host = mujoco.MjModel.from_xml_string(SCENE)
    with wp.ScopedDevice(device):
        model, data = mjw.put_model(host), mjw.make_data(host, nworld=worlds)
        shapes, bodies = sk.mujoco_shapes(host, worlds), wp.empty(worlds * host.nbody, dtype=wp.transform)
        config = sk.SpadConfig(width=80, height=60, vertical_fov=0.8)
        mount = {"body": [w * host.nbody + 1 for w in range(worlds)], "offset": (0.0, 0.0, -0.25, 0.0, 0.0, 0.0, 1.0)}
        camera = sk.SpadCamera(config, worlds, **mount, outputs=("depth",))
        for _ in range(steps):
            mjw.step(model, data)
            sk.write_poses(data.xpos, data.xquat, bodies)
            camera.update(shapes, body_q=bodies)
    return camera


if __name__ == "__main__":
    depth = main().depth.numpy()
    print(f"depth {depth.shape}, {depth[0, 30, 40]:.3f} m in the middle of the first image")
