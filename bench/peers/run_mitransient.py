"""staircase_5m on mitransient (Mitsuba 3: LLVM or CUDA) and on spadwarp, in one run: camera paths to photons.

The same water, mesh, laser, camera and bins. mitransient starts its paths at the camera and connects them to the laser;
one of its paths is held against one of our photons. How far the error of each falls in a second is another matter:
`spadwarp bench` prints ours.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _common import compare, fastest, options, peer, skip

SIZE, BINS = 64, 1024


def staircase(folder: str) -> str:
    """The target as a PLY file in the camera frame."""
    import trimesh

    from spadwarp.benchmark import CASES
    from spadwarp.config import Scene
    from spadwarp.targets import build_mesh

    mesh = build_mesh(Scene.from_dict(CASES["staircase_5m"].scene))
    assert mesh is not None
    path = Path(folder, "staircase.ply")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return str(path)


def scene(mi: Any, mesh: str) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at
    water = {"type": "ref", "id": "water"}
    return {
        "type": "scene",
        "water": {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3, "phase": {"type": "hg", "g": 0.924}},
        "integrator": {"type": "transient_prbvolpath", "max_depth": 64, "rr_depth": 1000},
        "sensor": {
            "type": "perspective",
            "fov": 30.0,
            "near_clip": 1e-3,
            "to_world": place([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "medium": water,
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
            "medium": water,
        },
        "target": {
            "type": "ply",
            "filename": mesh,
            "exterior": water,
            "bsdf": {"type": "twosided", "material": {"type": "diffuse", "reflectance": 0.5}},
        },
    }


if __name__ == "__main__":
    mi = peer("mitsuba", "pip install mitransient")
    args = options("staircase_5m on mitransient and on spadwarp", photons=1 << 22)
    for variant in ("cuda_ad_mono", "llvm_ad_mono"):
        try:
            mi.set_variant(variant)
            mi.Float(0.0) + mi.Float(1.0)
            break
        except (ImportError, RuntimeError, AttributeError):
            continue
    else:
        skip("Mitsuba finds neither CUDA nor LLVM")
    peer("mitransient", "pip install mitransient")
    samples = max(1, args.photons // SIZE**2)

    with tempfile.TemporaryDirectory() as folder:
        loaded = mi.load_dict(scene(mi, staircase(folder)))
    seconds, image = fastest(lambda: np.array(mi.render(loaded, spp=samples, seed=1)[1]), args.repeats)
    print(f"mitransient  {variant}, {seconds:.3g} s a run of {samples} paths a pixel; sum {np.sum(image):.4g}")
    compare("staircase_5m", samples * SIZE**2 / seconds, name="mitransient", unit="camera paths", args=args)
