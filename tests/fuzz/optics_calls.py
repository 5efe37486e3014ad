"""Valid calls of what a transport model is made of, and launches that use it all, to be changed by `kernel_calls`."""

import functools

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from spadwarp_kernels import analytic


def valid_calls(mesh: wp.Mesh) -> dict:
    window = {"index": (1.0, 1.5, 1.34), "group_index": (1.0, 1.5, 1.36)}
    cells = np.full((4, 2, 2), 0.3)
    grid = sk.make_grid(cells, 0.5 * np.ones_like(cells), size=(2.0, 2.0, 6.0), centre=(0, 0, 4.0), device="cpu")
    flat = {"distance": 0.05, "thickness": 0.01, "normal": (0.0, 0.0, 1.0), **window}
    derivatives = {"kinds": ("absorption", "reflectance"), "value": [0.1, 0.5], "scale": [2.0**40] * 2, "channels": 0}
    derivatives |= {"waters": [0], "faces": [0] * 12, "blocks": None, "device": "cpu"}
    calls = {
        "make_blocks": (sk.make_blocks, {"grid": grid, "shape": (2, 1, 1), "scale": [1.0, 2.0]}),
        "make_boundary": (
            sk.make_boundary,
            {"low": [0.75, 0.0, 0.0], "high": [0.0, 0.0, 0.0], "max_reflections": 2, "device": "cpu"},
        ),
        "make_derivatives": (sk.make_derivatives, derivatives),
        "make_dome_port": (
            sk.make_dome_port,
            {"radius": 0.08, "thickness": 0.01, "centre": (0.0, 0.0, 0.01), "origin": (0.0, 0.0, 0.0), **window}
            | {"aperture_radius": 0.0, "largest_angle": 0.6},
        ),
        "make_flat_port": (sk.make_flat_port, flat | {"aperture_radius": 0.0, "largest_angle": 0.6}),
        "make_polarisation": (
            sk.make_polarisation,
            {"laser": (1.0, 1.0, 0.0, 0.0), "matrix": lambda c: np.tile([0.0, 1, 1, 0, 1], (len(c), 1))}
            | {"channels": [[1.0, 0.0, 0.0, 0.0]], "facet_index": [1.3], "device": "cpu"},
        ),
        "has_overflowed": (sk.has_overflowed, {"tally": wp.zeros(12, dtype=wp.int64, device="cpu"), "signed": False}),
        "surface_choices": (sk.surface_choices, {"surfaces": sk.make_surfaces(mesh, 0.5)}),
        "sphere_integral": (sk.sphere_integral, {"function": np.ones_like}),
        "rayleigh": (sk.rayleigh_density, {"t": 0.5, "depolarisation_ratio": 0.03}),
        "make_optics": (analytic.make_optics, {"port": sk.FLAT_PORT, "laser_port": None}),
    }
    return calls | _launches(mesh, grid, flat)


def _launches(mesh: wp.Mesh, grid, flat: dict) -> dict:
    """Launches in cells of water behind a port, and of a confocal scan in a vessel with layers and derivatives."""
    tiles = {"face": np.zeros(12, int), "coordinates": np.zeros((12, 3, 2)), "images": [np.ones((2, 2))]}
    textures = sk.make_textures(**tiles, device="cpu")
    behind, within = lit_box(), lit_box()
    behind["camera"].port = sk.make_flat_port(**flat, aperture_radius=0.01, largest_angle=0.6)
    layers = sk.Layers()
    layers.grid = grid
    blocks = sk.make_blocks(grid, (2, 1, 1), [2.0**40])
    cloud = sk.Model(
        device="cpu",
        mesh=mesh,
        surfaces=sk.make_surfaces(mesh, 0.5, textures=textures, specular=0.1, use_warp_bvh=True),
        scale=2.0**50,
        layers=layers,
        derivatives=sk.make_derivatives((), (), (), blocks=blocks, device="cpu"),
        **behind,
    )
    in_cloud = sk.TransportSpec(
        "guided", mesh=True, pattern=True, specular=True, use_warp_bvh=True, grid=sk.REGULAR_TRACKING,
        port=sk.FLAT_PORT, blocks=("absorption",),
    )  # fmt: skip
    limits, camera, laser = within["limits"], within["camera"], within["laser"]
    limits.lower, limits.upper, limits.lateral = wp.vec3(-1.5, -1.5, -1.0), wp.vec3(1.5, 1.5, 9.0), 1e30
    limits.boundary = sk.make_boundary([0.75, 0.0, 0.0], [0.0, 0.0, 0.0], device="cpu")
    camera.focal, camera.principal = wp.vec2(20.0, 20.0), wp.vec2(2.0, 1.5)
    camera.view = wp.vec4(-0.1, -0.1, 0.1, 0.1)
    laser.rows = wp.array([0.5, 1.0], dtype=float, device="cpu")
    laser.columns = wp.array([[0.5, 1.0], [0.5, 1.0]], dtype=float, device="cpu")
    laser.extent = wp.vec2(0.05, 0.05)
    scan = sk.Scan()
    scan.count = 12
    scan.axis = wp.full(12, wp.vec3(0.0, 0.0, 1.0), dtype=wp.vec3, device="cpu")
    scan.view = wp.full(12, wp.vec4(-0.1, -0.1, 0.1, 0.1), dtype=wp.vec4, device="cpu")
    parts = {"start": [-1e30, 5.0], "extinction": [0.3, 0.5], "albedo": [0.8, 0.7], "anisotropy": [0.9, 0.8]}
    vessel = sk.Model(
        device="cpu",
        mesh=mesh,
        surfaces=sk.make_surfaces(mesh, 0.5),
        scale=2.0**50,
        layers=sk.make_layers(*parts.values(), axis=(0.0, 0.0, 1.0), device="cpu"),
        scan=scan,
        derivatives=sk.make_derivatives(
            ("absorption", "reflectance"), [0.1, 0.5], [2.0**40] * 2, waters=[0, -1], faces=[0] * 12, device="cpu"
        ),
        **within,
    )
    in_vessel = sk.TransportSpec(
        "next_event", mesh=True, layered=True, lens=sk.CALIBRATED, confocal=True, measured_beam=True, bounded=True,
        reflecting=True, derivatives=("absorption", "reflectance"), records=True,
    )  # fmt: skip
    made = {}
    for name, spec, model, derivatives in (("cloud", in_cloud, cloud, 2), ("vessel", in_vessel, vessel, 2)):
        data = sk.make_data(model, derivatives=derivatives, record_count=20)
        given = {"model": model, "data": data, "seed": 1, "first_id": 0, "photon_count": 20}
        # A spec that is changed and valid is compiled, which takes longer than a case may.
        made[f"launch in a {name}"] = (functools.partial(sk.launch_transport, spec), given)
    return made
