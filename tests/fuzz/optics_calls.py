"""Valid calls of what a transport model is made of, and launches that use it all, to be changed by `kernel_calls`."""

import functools

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from spadwarp_kernels import analytic


def valid_calls(mesh: wp.Mesh) -> dict:
    window = dict(index=(1.0, 1.5, 1.34), group_index=(1.0, 1.5, 1.36))
    cells, walls = np.full((4, 2, 2), 0.3), dict(max_reflections=2)
    grid = sk.make_grid(cells, 0.5 * np.ones_like(cells), size=(2.0, 2.0, 6.0), centre=(0, 0, 4.0), device="cpu")
    flat = dict(distance=0.05, thickness=0.01, normal=(0.0, 0.0, 1.0), **window)
    lens = dict(aperture_radius=0.0, largest_angle=0.6)
    sea = dict(variances=(0.01, 0.02), index=1.34, normal=(0.0, 0.0, -1.0), height=-3.0)
    calls = {
        "make_blocks": (sk.make_blocks, dict(grid=grid, shape=(2, 1, 1), scale=[1.0, 2.0])),
        "make_boundary": (sk.make_boundary, dict(low=[0.75, 0.0, 0.0], high=[0.0, 0.0, 0.0], device="cpu", **walls)),
        "make_derivatives": (sk.make_derivatives, dict(
            kinds=("absorption", "reflectance"), value=[0.1, 0.5], scale=[2.0**40] * 2, channels=0, waters=[0],
            faces=[0] * 12, blocks=None, device="cpu")),
        "make_dome_port": (sk.make_dome_port, dict(
            radius=0.08, thickness=0.01, centre=(0.0, 0.0, 0.01), origin=(0.0, 0.0, 0.0), **window, **lens)),
        "make_flat_port": (sk.make_flat_port, flat | lens | dict(sea=sk.make_sea(**sea))),
        "make_sea": (sk.make_sea, sea | dict(along=(1.0, 0.0, 0.0), delay=0.73, extinction=0.1)),
        "slope_variances": (sk.slope_variances, dict(wind=5.0, by_direction=True)),
        "make_polarisation": (sk.make_polarisation, dict(
            laser=(1.0, 1.0, 0.0, 0.0), matrix=lambda c: np.tile([0.0, 1, 1, 0, 1], (len(c), 1)),
            channels=[[1.0, 0.0, 0.0, 0.0]], facet_index=[1.3], device="cpu")),
        "has_overflowed": (sk.has_overflowed, dict(tally=wp.zeros(12, dtype=wp.int64, device="cpu"), signed=False)),
        "surface_choices": (sk.surface_choices, dict(surfaces=sk.make_surfaces(mesh, 0.5))),
        "sphere_integral": (sk.sphere_integral, dict(function=np.ones_like)),
        "rayleigh": (sk.rayleigh_density, dict(t=0.5, depolarisation_ratio=0.03)),
        "make_optics": (analytic.make_optics, dict(port=sk.FLAT_PORT, laser_port=None)),
    }  # fmt: skip
    return calls | _launches(mesh, grid, flat)


def _launches(mesh: wp.Mesh, grid, flat: dict) -> dict:
    """Launches in cells of water behind a port, and of a confocal scan in a vessel with layers and derivatives."""
    tiles = dict(face=np.zeros(12, int), coordinates=np.zeros((12, 3, 2)), images=[np.ones((2, 2))])
    behind, within = lit_box(), lit_box()
    behind["camera"].port = sk.make_flat_port(**flat, aperture_radius=0.01, largest_angle=0.6)
    layers = sk.Layers()
    layers.grid = grid
    blocks = sk.make_blocks(grid, (2, 1, 1), [2.0**40])
    patterned = dict(textures=sk.make_textures(**tiles, device="cpu"), specular=0.1, use_warp_bvh=True)
    cloud = sk.Model(
        device="cpu", mesh=mesh, surfaces=sk.make_surfaces(mesh, 0.5, **patterned), scale=2.0**50, layers=layers,
        derivatives=sk.make_derivatives((), (), (), blocks=blocks, device="cpu"), **behind,
    )  # fmt: skip
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
    kinds = ("absorption", "reflectance")
    vessel = sk.Model(
        device="cpu", mesh=mesh, surfaces=sk.make_surfaces(mesh, 0.5), scale=2.0**50, scan=scan,
        layers=sk.make_layers([-1e30, 5.0], [0.3, 0.5], [0.8, 0.7], [0.9, 0.8], axis=(0.0, 0.0, 1.0), device="cpu"),
        derivatives=sk.make_derivatives(
            kinds, [0.1, 0.5], [2.0**40] * 2, waters=[0, -1], faces=[0] * 12, device="cpu"
        ), **within,
    )  # fmt: skip
    in_vessel = sk.TransportSpec(
        "next_event", mesh=True, layered=True, lens=sk.CALIBRATED, confocal=True, measured_beam=True, bounded=True,
        reflecting=True, derivatives=kinds, records=True,
    )  # fmt: skip
    made = {}
    for name, spec, model in (("cloud", in_cloud, cloud), ("vessel", in_vessel, vessel)):
        data = sk.make_data(model, derivatives=2, record_count=20)
        # A spec that is changed and valid is compiled, which takes longer than a case may.
        launch = functools.partial(sk.launch_transport, spec)
        made[f"launch in a {name}"] = (launch, dict(model=model, data=data, seed=1, first_id=0, photon_count=20))
    return made
