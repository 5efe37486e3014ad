"""staircase_5m on mitransient (Mitsuba 3: CUDA or LLVM) and on spadwarp, in one run: paths per second, and how far the
error of each falls in a second.

The same water, mesh, laser, camera and bins. mitransient starts its paths at the camera and connects them to the laser;
one of its paths is held against one of our photons. What counts in the end is variance x time: how long one takes to
reach the error of the other. It is compared pixel by pixel and time bin by time bin, as relative variance between seeds
times the seconds of a run. Rare, bright paths make the variance of few seeds look smaller than it is: more `--seeds`
and `--photons` bring mitransient's nearer to the truth.
"""

import itertools
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _common import compare, options, peer, skip

SIZE, BINS = 64, 1024

# Variances are compared in blocks of 2 x 2 pixels and time bins of 32 cm path.
BLOCK, TIME_BINS = 2, 64


def staircase(folder: str) -> str:
    """The target as a PLY file in the camera frame."""
    import trimesh

    from spadwarp.benchmark import CASES
    from spadwarp.mesh import build_mesh
    from spadwarp.scene import Scene

    mesh = build_mesh(Scene.from_dict(CASES["staircase_5m"].scene))
    assert mesh is not None
    path = Path(folder, "staircase.ply")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return str(path)


def scene(mi: Any, mesh: str, roulette_from: int) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at
    water = {"type": "ref", "id": "water"}
    return {
        "type": "scene",
        "water": {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3, "phase": {"type": "hg", "g": 0.924}},
        # Camera and laser stand right before the water: mitransient's paths start in no medium.
        "volume": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([0, 0, 15.001]).scale([30, 30, 15]),
            "bsdf": {"type": "null"},
            "interior": water,
        },
        "integrator": {"type": "transient_prbvolpath", "max_depth": 64, "rr_depth": roulette_from},
        "sensor": {
            "type": "perspective",
            "fov": 30.0,
            "near_clip": 1e-4,
            "to_world": place([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "film": {
                "type": "transient_hdr_film",
                "width": SIZE,
                "height": SIZE,
                "temporal_bins": BINS,
                "start_opl": 0.0,
                "bin_width_opl": 0.02,
                "rfilter": {"type": "box"},
            },
        },
        "laser": {
            "type": "spot",
            "cutoff_angle": 15.0,
            "beam_width": 14.999,
            "to_world": place([-0.05, 0, 0], [-0.05, 0, 1], [0, -1, 0]),
        },
        "target": {
            "type": "ply",
            "face_normals": True,  # else Mitsuba smooths them over the corners
            "filename": mesh,
            "exterior": water,
            "bsdf": {"type": "twosided", "material": {"type": "diffuse", "reflectance": 0.5}},
        },
    }


def spread(run: Callable[[int], tuple[np.ndarray, float]], seeds: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and variance between seeds [block row, block column, time bin], and the seconds of a run."""
    run(0)
    total = squares = 0.0
    seconds = []
    for seed in range(1, seeds + 1):
        cube, took = run(seed)
        blocks = cube.reshape(SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK, TIME_BINS, -1).sum(axis=(1, 3, 5))
        total = total + blocks
        squares = squares + blocks**2
        seconds.append(took)
    mean = total / seeds
    return mean, (squares / seeds - mean**2) * seeds / (seeds - 1), float(np.median(seconds))


if __name__ == "__main__":
    mi = peer("mitsuba", "pip install mitransient")
    args = options(
        "staircase_5m on mitransient and on spadwarp",
        photons=1 << 22,
        more={
            "seeds": (16, "runs whose spread is the error; 0: no errors"),
            "roulette-from": (5, "mitransient's rr_depth"),
        },
    )
    seeds, roulette_from = args.seeds, args.roulette_from
    # Dr.Jit looks for LLVM's library by itself or where DRJIT_LIBLLVM_PATH says. LLVM up to 16 lacks an instruction
    # that Mitsuba uses and ends the process; 19 has it.
    for variant in ("llvm_ad_mono",) if args.device == "cpu" else ("cuda_ad_mono", "llvm_ad_mono"):
        try:
            mi.set_variant(variant)
            mi.Float(0.0) + mi.Float(1.0)
            break
        except (ImportError, RuntimeError, AttributeError):
            continue
    else:
        skip("Mitsuba finds neither CUDA nor LLVM")
    their_version = peer("mitransient", "pip install mitransient").__version__
    import drjit

    import spadwarp
    from spadwarp.benchmark import CASES

    samples = max(1, args.photons // SIZE**2)
    with tempfile.TemporaryDirectory() as folder:
        loaded = mi.load_dict(scene(mi, staircase(folder), roulette_from))

    def render(seed: int) -> Any:
        film = mi.render(loaded, spp=samples, seed=seed)[1]
        drjit.eval(film)
        drjit.sync_thread()
        return film

    def theirs(seed: int) -> tuple[np.ndarray, float]:
        began = time.perf_counter()
        film = render(seed)
        took = time.perf_counter() - began
        return np.array(film, dtype=np.float64)[..., 0], took

    our_scene = spadwarp.Scene.from_dict(CASES["staircase_5m_guided"].scene).with_overrides(
        {"transport.points_per_flight": "auto"}
    )

    def ours(seed: int) -> tuple[np.ndarray, float]:
        # Long enough that the way of the histogram to the host does not count.
        result = spadwarp.simulate(our_scene, photons=10 * args.photons, seed=seed, device=args.device)
        return result.histogram, result.timing["trace"]

    def run() -> None:
        render(next(seed_of))

    seed_of = itertools.count(1)
    print(f"mitransient  {their_version} on Mitsuba {mi.__version__} and Dr.Jit {drjit.__version__}, {variant}")
    print(f"             {samples} paths a pixel, roulette from {roulette_from}")
    compare("staircase_5m", run, name="mitransient", unit="camera paths", work=samples * SIZE**2, args=args)
    if seeds == 0:
        sys.exit(0)

    their_mean, their_variance, their_seconds = spread(theirs, seeds)
    our_mean, our_variance, our_seconds = spread(ours, max(8, seeds // 2))
    seen = (their_mean > 0) & (our_mean > 0)
    # Theirs is radiance, ours what the aperture collects of it: cos^4 of the field angle and a constant apart.
    tangent = np.tan(np.radians(15)) * (2 * (np.arange(SIZE // BLOCK) + 0.5) / (SIZE // BLOCK) - 1)
    falloff = (1 + tangent[:, None] ** 2 + tangent**2) ** -2.0
    ratio = (their_mean * falloff[..., None]).sum(axis=(0, 1)) / our_mean.sum(axis=(0, 1))
    error = np.sqrt((their_variance * falloff[..., None] ** 2).sum(axis=(0, 1)) / seeds) / our_mean.sum(axis=(0, 1))
    known = error < 0.05 * ratio
    print(f"means        theirs/ours over {known.sum()} time bins known to 5 %: ")
    scale = np.average(ratio[known], weights=error[known] ** -2.0)
    ratios = [f"{r / scale:.3f}±{e / scale:.3f}" for r, e in zip(ratio[known], error[known], strict=True)]
    print("             " + " ".join(ratios))
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = (their_variance / their_mean**2 * their_seconds) / (our_variance / our_mean**2 * our_seconds)
        sums = [
            (v.sum(axis=(0, 1)) / m.sum(axis=(0, 1)) ** 2)
            for v, m in ((their_variance, their_mean), (our_variance, our_mean))
        ]
        by_time = sums[0] * their_seconds / (sums[1] * our_seconds)
    lower, median, upper = np.percentile(gain[seen], [25, 50, 75])
    print(f"variance x time: {seen.mean():.1%} of the blocks and time bins seen by both; of these")
    print(f"             theirs/ours is {median:.0f} in the median (quartiles {lower:.0f}, {upper:.0f})")
    print(f"             of whole time bins, in the median {np.nanmedian(by_time):.0f}")
