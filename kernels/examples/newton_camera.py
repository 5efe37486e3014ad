"""Single-photon cameras in a Newton simulation: a box falls into murky water, in several worlds at once."""

import newton
import warp as wp

import spadwarp_kernels as sk


def main(worlds=4, steps=60, device=None):
    """The depth images of the last step, `[worlds, height, width]`."""
    world = newton.ModelBuilder()
    box = world.add_body(xform=wp.transform((0.0, 0.0, 1.5), wp.quat_rpy(0.3, 0.4, 0.0)))
    world.add_shape_box(box, hx=0.3, hy=0.2, hz=0.2)
    scene = newton.ModelBuilder()
    scene.replicate(world, worlds)
    scene.add_ground_plane()
    model = scene.finalize(device=device)
    solver, collisions = newton.solvers.SolverXPBD(model), newton.CollisionPipeline(model)
    state, after, control, contacts = model.state(), model.state(), model.control(), collisions.contacts()

    shapes = sk.newton_shapes(model)
    camera = sk.SpadCamera(sk.SpadConfig(width=80, height=60), worlds, frame="opengl", device=model.device)
    pose = wp.transform((0.0, -3.0, 1.0), wp.quat_rpy(1.3, 0.0, 0.0))  # looks along +y, a little down
    poses = wp.array([pose] * worlds, dtype=wp.transform, device=model.device)
    for _ in range(steps):
        collisions.collide(state, contacts)
        solver.step(state, after, control, contacts, 0.01)
        state, after = after, state
        camera.update(shapes, poses, state.body_q)
    return camera.depth


if __name__ == "__main__":
    depth = main().numpy()
    print(f"depth {depth.shape}, {depth[0, 30, 40]:.3f} m in the middle of the first image")
