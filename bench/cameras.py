"""Steps per second of SpadCamera and SpadTracer in many worlds, each step one CUDA graph.

    python bench/cameras.py                          # 16 worlds x 160 x 120 x 256 bins, 1e6 photons a world
    python bench/cameras.py --worlds 4096 --size 64 48 --photons 0 --steps 20
    python bench/cameras.py --device cpu --worlds 1 --size 32 24 --bins 64 --photons 2e4 --steps 2

A world is a floor, a wall and ten bodies, which move in the graph. The capture itself shows that a step neither waits
for the device nor reads from it: CUDA refuses both while it captures. Before the timing, replays are held to plain
calls, bit by bit; after it, the depth in clear water to the truth. The outputs
are depths alone, but for those of the cameras that are compared; "by world" has water of its own in each world.
Without photons the tracer is left out.
"""

import argparse
import dataclasses
import time

import numpy as np
import warp as wp

import spadwarp_kernels as sk

KINDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid")
BODIES = 10


def scene(worlds, device):
    """Shapes of all worlds, and the poses of their bodies."""
    rng = np.random.default_rng(1)
    turns = rng.normal(size=(BODIES, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    places = np.stack(
        [rng.uniform(-1.5, 1.5, BODIES), rng.uniform(-0.8, 0.6, BODIES), rng.uniform(2, 4, BODIES)], axis=1
    )
    floor = [0, 1, 0, *(wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), np.pi / 2))]
    shapes = sk.make_shapes(
        ["plane", "plane", *[KINDS[k % len(KINDS)] for k in range(BODIES)] * worlds],
        [(0, 0, 0), (0, 0, 0), *[(0.25, 0.2, 0.15)] * (BODIES * worlds)],
        body=[-1, -1, *range(BODIES * worlds)],
        local=[floor, (0, 0, 6, 0, 0, 0, 1), *[(0, 0, 0, *turn) for turn in turns] * worlds],
        reflectance=0.4,
        world=[-1, -1, *np.repeat(np.arange(worlds), BODIES)],
        worlds=worlds,
        device=device,
    )
    rows = [(*place, 0, 0, 0, 1) for _ in range(worlds) for place in places]
    return shapes, wp.array(np.array(rows, np.float32), dtype=wp.transform, device=device)


@wp.kernel(enable_backward=False)
def move(step: wp.array(dtype=wp.int64), rest: wp.array(dtype=wp.transform), body_q: wp.array(dtype=wp.transform)):
    """Bodies swing, each in its own phase. Launch: bodies."""
    k = wp.tid()
    shift = wp.vec3(0.1 * wp.sin(0.1 * float(step[0]) + float(k)), 0.0, 0.0)
    body_q[k] = wp.transform(wp.transform_get_translation(rest[k]) + shift, wp.transform_get_rotation(rest[k]))


def build(kind, config, options, device, **choices):
    """A camera and the function that is a step of the simulation and of it."""
    shapes, rest = scene(options.worlds, device)
    poses = wp.array([wp.transform_identity()] * options.worlds, dtype=wp.transform, device=device)
    body_q = wp.clone(rest)
    if kind == "SpadCamera":
        camera = sk.SpadCamera(config, options.worlds, frame="optical", device=device, **choices)
    else:
        tracing = {"photons": int(options.photons), "lanes": options.lanes}
        camera = sk.SpadTracer(shapes, config, options.worlds, frame="optical", **tracing, **choices)

    def step():
        wp.launch(move, rest.size, [camera.step, rest], [body_q], device=device)
        if kind == "SpadCamera":
            camera.update(shapes, poses, body_q)
        else:
            camera.update(poses, body_q)

    return camera, step


def captured(camera, step, device):
    """The step as a graph, after a first one that compiles and builds."""
    step()
    with wp.ScopedCapture(device=device) as capture:
        step()
    return capture.graph


def check_replay(kind, config, options, device):
    """A replay is a call, bit by bit."""
    camera, step = build(kind, config, options, device)
    graph = captured(camera, step, device)
    other, other_step = build(kind, config, options, device)
    other_step()
    wp.capture_launch(graph)
    other_step()
    for name in ("rates", "histogram", "depth"):
        mine, theirs = getattr(camera, name).numpy(), getattr(other, name).numpy()
        if not np.array_equal(mine, theirs, equal_nan=True):
            raise SystemExit(f"{kind}: the replay's {name} is not that of a call")


def measure(kind, config, options, device, by_world=False):
    before = device.free_memory if device.is_cuda else 0
    choices = {"outputs": ("depth",)}
    if by_world:
        draw = np.random.default_rng(2).uniform
        choices["by_world"] = {
            "scattering": draw(0.1, 0.4, options.worlds),
            "absorption": draw(0.05, 0.2, options.worlds),
        }
    camera, step = build(kind, config, options, device, **choices)
    graph = captured(camera, step, device)
    wp.synchronize_device(device)
    memory = (before - device.free_memory) / 1e9 if device.is_cuda else float("nan")
    began = time.perf_counter()
    for _ in range(options.steps):
        wp.capture_launch(graph)
    wp.synchronize_device(device)
    rate = options.steps / (time.perf_counter() - began)
    name = f"{kind:10s} {config.method:10s}{' by world' if by_world else '':9s}"
    print(f"{name} {rate:9.2f} steps/s, {rate * options.worlds:10.1f} images/s, {memory:6.2f} GB", flush=True)


def clear_water(config, options, device):
    """Offset of the measured depth from the truth, where pile-up is rare."""
    clear = dataclasses.replace(config, absorption=0.0, scattering=0.0, pulse_energy=2e-11, pulses=200_000)
    camera, step = build("SpadCamera", clear, options, device)
    step()
    error = camera.depth.numpy() - camera.true_depth.numpy()
    offset, spread = np.nanmedian(error), np.nanmedian(abs(error))
    print(f"clear water: median offset {1e3 * offset:+.3f} mm, median error {1e3 * spread:.2f} mm")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--bins", type=int, default=256)
    parser.add_argument("--photons", type=float, default=1e6, help="of a step and world")
    parser.add_argument("--lanes", type=int, default=16, help="cameras that SpadTracer traces side by side on a GPU")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--device", help='"cpu" or "cuda:0"; by default the GPU, if there is one')
    options = parser.parse_args()
    device = wp.get_device(options.device)
    width, height = options.size
    config = sk.SpadConfig(width=width, height=height, bins=options.bins)
    print(f"{options.worlds} worlds x {width} x {height} x {options.bins} bins on {device.name}, Warp {wp.__version__}")
    for method in ("centroid", "matched", "likelihood"):
        measure("SpadCamera", dataclasses.replace(config, method=method), options, device)
    measure("SpadCamera", dataclasses.replace(config, method="matched"), options, device, by_world=True)
    if options.photons:
        measure("SpadTracer", config, options, device)
    options.worlds = min(options.worlds, 16)
    for kind in ("SpadCamera", "SpadTracer") if options.photons else ("SpadCamera",):
        check_replay(kind, config, options, device)
    clear_water(config, options, device)


if __name__ == "__main__":
    main()
