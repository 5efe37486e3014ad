"""A SPAD camera on a Warp simulation whose mesh moves: a transient video comes out.

A cloth in turbid water waves in front of the camera. Each step the simulation moves the mesh's points and refits its
BVH; the camera is a `Model` around the same mesh, and its tallies of the step are one row of an array of ours.

    python kernels/examples/moving_target.py --steps 48 --photons 1e8 --out video.npy --picture video.gif
"""

import argparse
import dataclasses
import math

import numpy as np
import warp as wp

import spadwarp_kernels as sk

DISTANCE, SIDE, CELLS = 4.0, 3.0, 48  # of the cloth [m], its cells along a side
WIDTH, HEIGHT, BINS = 64, 48, 128
GATE = (5.0, 9.0)  # of path, laser to cloth to lens [m]


@wp.kernel(enable_backward=False)
def wave(rest: wp.array(dtype=wp.vec3), time: float, points: wp.array(dtype=wp.vec3)):
    """The simulation: a travelling wave. Launch: points."""
    i = wp.tid()
    p = rest[i]
    points[i] = p + wp.vec3(0.0, 0.0, 0.3 * wp.sin(2.5 * p[0] - 3.0 * time) * wp.cos(1.5 * p[1]))


def cloth(device):
    """A square grid of triangles."""
    x = np.linspace(-0.5 * SIDE, 0.5 * SIDE, CELLS + 1)
    points = np.stack([*np.meshgrid(x, x), np.full((CELLS + 1, CELLS + 1), DISTANCE)], axis=-1).reshape(-1, 3)
    row = CELLS + 1
    first = (np.arange(CELLS)[:, None] * row + np.arange(CELLS)).ravel()
    faces = np.stack([first, first + row, first + 1, first + 1, first + row, first + row + 1], axis=1)
    return wp.Mesh(wp.array(points, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=int, device=device))


def camera_on(mesh):
    """The model without its surfaces, which change from step to step."""
    medium, laser, camera, gate = sk.Medium(), sk.Laser(), sk.Camera(), sk.Gate()
    limits, guiding = sk.Limits(), sk.Guiding()
    medium.extinction, medium.albedo, medium.anisotropy, medium.axis_threshold = 0.3, 0.8, 0.924, 1.0
    laser.position, laser.axis, laser.spread = wp.vec3(0.1, 0.0, 0.0), wp.vec3(0.0, 0.0, 1.0), 1.0 - math.cos(0.4)
    camera.width, camera.height, camera.pixel_tangent = WIDTH, HEIGHT, 0.7 / WIDTH
    camera.aperture_radius, camera.aperture_area = 0.01, math.pi * 0.01**2
    camera.inverse_focus = 1.0 / DISTANCE
    gate.start, gate.stop, gate.bins, gate.bins_per_metre = *GATE, BINS, BINS / (GATE[1] - GATE[0])
    limits.lower, limits.upper, limits.lateral = wp.vec3(-1e30), wp.vec3(1e30), 1e30
    limits.max_path, limits.max_collisions, limits.weight_cutoff = GATE[1], 64, 2e-4
    guiding.probability = guiding.surface_probability = 0.3
    guiding.anisotropy, guiding.return_probability, guiding.return_anisotropy = 0.97, 0.1, 0.5
    # Tally units of a photon: large enough for the weakest contribution, 2^62 / photons for the brightest bin.
    return sk.Model(mesh.device, medium, laser, camera, gate, limits, guiding, mesh, sk.make_surfaces(mesh), 2.0**55)


def film(steps, photons, *, seed=1, device=None):
    """Fraction of the emitted photons by step, row, column and bin: float64 `[step, HEIGHT, WIDTH, BINS]`."""
    mesh = cloth(device)
    rest = wp.clone(mesh.points)
    reflectance = wp.full(mesh.indices.size // 3, 0.5, dtype=float, device=mesh.device)
    model = camera_on(mesh)
    spec = sk.TransportSpec("guided")
    tallies = wp.zeros((steps, model.tally_size), dtype=wp.int64, device=mesh.device)  # ours: all steps
    for step in range(steps):
        wp.launch(wave, dim=rest.size, inputs=[rest, 2.0 * step / steps], outputs=[mesh.points], device=mesh.device)
        mesh.refit()
        # The bounding box and what the camera cannot miss have changed with the mesh.
        model = dataclasses.replace(model, surfaces=sk.make_surfaces(mesh, reflectance, camera=model.camera))
        data = sk.make_data(model, tally=tallies[step])
        for first in range(0, photons, 1 << 26):
            count = min(1 << 26, photons - first)
            sk.launch_transport(spec, model, data, seed=seed, first_id=step * photons + first, photon_count=count)
    parts = tallies.numpy().reshape(steps, len(sk.COMPONENTS), HEIGHT, WIDTH, BINS)
    return parts.sum(axis=1) / (model.scale * photons)


def draw(video, path):
    """The video as an animated GIF: light by column and path, and half the path of the brightest bin."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import animation, colors, pyplot

    pyplot.rcParams.update({"font.size": 8, "axes.titlesize": 8})
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(7.2, 3.0), layout="constrained", dpi=120)
    width = (GATE[1] - GATE[0]) / BINS
    distance = 0.5 * (GATE[0] + (video.argmax(axis=-1) + 0.5) * width)
    slices = video.sum(axis=1).transpose(0, 2, 1)  # [step, bin, column]
    top = slices.max()
    scale = colors.LogNorm(1e-4 * top, top)
    light = pyplot.colormaps["inferno"].with_extremes(bad="black", under="black")
    transient = left.imshow(slices[0], origin="lower", aspect="auto", extent=(0, WIDTH, *GATE), norm=scale, cmap=light)
    image = right.imshow(distance[0], vmin=DISTANCE - 0.4, vmax=DISTANCE + 0.4, cmap="viridis_r")
    left.set(xlabel="column [pixel]", ylabel="path [m]", title="light by column and path")
    right.set(xlabel="column [pixel]", ylabel="row [pixel]", title="brightest bin")
    left.minorticks_on()
    figure.colorbar(transient, ax=left, label="part of the emitted light\nper column and bin", extend="min")
    figure.colorbar(image, ax=right, label="half the path [m]", extend="both", shrink=0.8).minorticks_on()

    def show(step):
        transient.set_data(slices[step])
        image.set_data(distance[step])

    animation.FuncAnimation(figure, show, len(video)).save(path, writer=animation.PillowWriter(fps=12))
    pyplot.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--photons", type=float, default=1e6, help="of each step")
    parser.add_argument("--device", help='"cpu" or "cuda:0"; by default the GPU, if there is one')
    parser.add_argument("--out", default="video.npy")
    parser.add_argument("--picture", help="GIF to draw (needs matplotlib)")
    options = parser.parse_args()
    video = film(options.steps, int(options.photons), device=options.device)
    np.save(options.out, video)
    print(f"{options.out}: {video.shape} [step, row, column, bin], {video.sum() / len(video):.3g} of the light a step")
    if options.picture:
        draw(video, options.picture)


if __name__ == "__main__":
    main()
