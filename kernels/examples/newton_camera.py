"""Single-photon cameras in a Newton simulation: on a tumbling box over a sphere in murky water, in several worlds."""

import newton
import warp as wp

import spadwarp_kernels as sk


def main(worlds=4, steps=20, device=None):
    """The camera after the last step; its images are `[worlds, height, width]`."""
    world, scene = newton.ModelBuilder(), newton.ModelBuilder()
    world.add_shape_box(world.add_body(xform=wp.transform((0.0, 0.0, 3.0), wp.quat_identity())), hx=0.3, hy=0.2, hz=0.2)
    world.add_shape_sphere(world.add_body(xform=wp.transform((0.0, 0.3, 0.3), wp.quat_identity())), radius=0.3)
    scene.replicate(world, worlds)
    scene.add_ground_plane()
    model = scene.finalize(device=device)
    solver, state, after, control = newton.solvers.SolverXPBD(model), model.state(), model.state(), model.control()
    config = sk.SpadConfig(width=80, height=60, vertical_fov=0.8)
    bodies = range(0, model.body_count, model.body_count // worlds)  # the box of each world
    offset = (0.0, 0.0, -0.25, 0.0, 0.0, 0.0, 1.0)  # below the box; -z is forward
    camera = sk.SpadCamera(config, worlds, body=bodies, offset=offset, outputs=("depth",), device=model.device)
    shapes = sk.newton_shapes(model)
    for _ in range(steps):
        solver.step(state, after, control, None, 0.01)
        state, after = after, state
        camera.update(shapes, body_q=state.body_q)
    return camera


if __name__ == "__main__":
    depth = main().depth.numpy()
    print(f"depth {depth.shape}, {depth[0, 30, 40]:.3f} m in the middle of the first image")
