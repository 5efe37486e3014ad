"""The kernel library with beginners' arguments: wrong kinds, shapes and devices, NaN, negative sizes."""

import dataclasses
import math
import random

import numpy as np
import trimesh
import warp as wp

import spadwarp_kernels as sk
from fuzz import optics_calls, world_calls
from fuzz.isolation import run_isolated
from helpers.lit_box import lit_box
from spadwarp_kernels import PortKind, analytic, detection
from spadwarp_kernels.optics.visibility import near_depth_map

NUMBERS = (0, -1, 1, 2, 1.5, -0.5, math.nan, math.inf, -math.inf, 1e30, 1e-30, 2**31 - 1, 2**31, 2**63, 2**64, -(2**31))
NUMBERS += (1e300, True, 10**40)
JUNK = (None, "a", "cpu", "cuda:0", [], {}, (), b"x", object(), np.float32(1), np.array(1.0))
_BASE: dict = {}


def warm_up() -> None:
    """The valid calls, which compile the kernels."""
    _BASE.update(_valid_calls())
    for call, arguments in _BASE.values():
        call(**arguments)


def run(number: int) -> tuple[str, str]:
    """Verdict and text of a call with one or two arguments changed."""
    outcome = run_isolated(lambda: _one(number), memory=4 << 30)
    return outcome.value if outcome.kind == "done" else (outcome.kind, f"{outcome.value}\n{outcome.text}")


def _one(number: int) -> tuple[str, str]:
    r = random.Random(f"kernels {number}")
    name = r.choice(sorted(_BASE))
    call, arguments = _BASE[name]
    arguments = dict(arguments)
    try:
        for _ in range(r.choice((1, 1, 1, 2))):
            key = r.choice(sorted(arguments))
            arguments[key] = _changed(r, arguments[key])
        call(**arguments)
    except sk.ArgumentError as error:
        return "refused", str(error)
    except RuntimeError as error:
        if "Failed to allocate" in str(error):
            return "refused", str(error)
        raise
    return "done", name


def _lidar():
    one = sk.Lidar()
    one.photons, one.pde, one.extinction, one.scattering, one.speed = 1e9, 0.2, 0.3, 0.2, 2.2e8
    one.axis, one.spread, one.tan2 = wp.vec3d(0.0, 0.0, 1.0), 0.02, 0.04
    one.pixel_tangent, one.aperture_area, one.sigma, one.dark = 0.01, 1e-4, 1e-10, 1e3
    one.stop, one.source, one.nearest = 1e-7, 1, 0.05
    return one


def _valid_calls():
    def floats(*shape, value=0.01, dtype=float):
        return wp.full(shape, value, dtype=dtype, device="cpu")

    def four(value=3.0):
        return floats(4, value=value, dtype=wp.float64)

    def tallies():
        return wp.zeros(12, dtype=wp.int64, device="cpu")

    box = trimesh.creation.box((1, 1, 1))
    box.apply_translation((0, 0, 5))
    points = wp.array(box.vertices, dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(points, wp.array(box.faces.ravel(), dtype=int, device="cpu"))
    model = sk.Model(device="cpu", mesh=mesh, surfaces=sk.make_surfaces(mesh, 0.5), scale=2.0**50, **lit_box())
    tiles = dict(face=np.zeros(12, int), coordinates=np.zeros((12, 3, 2)), images=[np.ones((2, 2))], device="cpu")
    sight = floats(4, value=wp.vec3(0, 0, 1), dtype=wp.vec3)
    view = floats(4, value=wp.vec3d(0, 0, 1), dtype=wp.vec3d)
    rows, counts = floats(6, 8), floats(6, 8, value=2, dtype=int)
    coding = analytic.FrameCoding()
    coding.nearest, coding.farthest, coding.width, coding.pixels = 1.0, 3.0, 2, 4
    coding.depth_step, coding.intensity_step, coding.pulses = 0.001, 1.0, 100.0
    maps = {name: floats(4) for name in ("depth", "sigma_depth", "probability", "flat_share")}
    maps |= dict(view=sight, paths=floats(1, 5), cumulative=floats(1, 5))
    drawn = dict(hazard=rows, pulses=10, frames=2, first_frame=0, counter_depth=0, seed=1, counts=None)
    bins = dict(background=floats(1, 8), response=np.ones((16, 3)) / 3, lowest_tap=-1, first=0, stop=8)
    scatter = dict(lidar=_lidar(), phase=floats(9, value=0.08, dtype=wp.float64), view=view)
    taps = wp.ones(3, dtype=wp.float64)
    calls = {
        "tally rates": (sk.tally_rates, dict(
            tally=tallies(), scale=wp.ones(2, dtype=wp.float64, device="cpu"), bins=2, components=3, parameters=1,
            parameter=0)),
        "launch": (sk.launch_transport, dict(
            spec=sk.TransportSpec("next_event"), model=model, data=sk.make_data(model), seed=1, first_id=0,
            photon_count=20)),
        "prepare": (sk.prepare_transport, dict(
            spec=sk.TransportSpec("next_event"), model=model, data=sk.make_data(model), seed=1, photon_count=20)),
        "make_data": (sk.make_data, dict(model=model, tally=None, record_count=3, histogram=True)),
        "Model": (sk.Model, dict(device="cpu", mesh=mesh, surfaces=model.surfaces, scale=1.0, **lit_box())),
        "make_surfaces": (sk.make_surfaces, dict(
            mesh=mesh, reflectance=floats(12), textures=sk.make_textures(**tiles), specular=0.1, roughness=0.2,
            camera=lit_box()["camera"], corner_reflectance=None)),
        "make_textures": (sk.make_textures, tiles),
        "make_grid": (sk.make_grid, dict(
            extinction=np.ones((2, 3, 4)), albedo=np.full((2, 3, 4), 0.5), anisotropy=None, size=(1, 1, 2),
            centre=(0, 0, 1.0), rotation=np.eye(3), block_edge=2, shares=np.full((2, 3, 4, 2), 0.5), device="cpu")),
        "make_layers": (sk.make_layers, dict(
            start=[0.0, 1.0], extinction=[1.0, 1.0], albedo=[0.5, 0.5], anisotropy=[0.1, 0.1], axis=(0, 0, 1.0),
            shares=[[0.25, 0.75], [0.5, 0.5]], device="cpu")),
        "make_lines": (sk.make_lines, dict(
            source=[1e-3, 1e-3], anisotropy=[0.55, 0.0], extinction=[0.4, 0.5], scattering=[0.1, 0.1],
            passed=[1.0, 0.5], media=[sk.make_medium(0.1, 0.1)], device="cpu")),
        "make_flux_volume": (sk.make_flux_volume, dict(
            shape=(2, 3, 4), lower=(0, 0, 0), edge=(1.0, 1.0, 2.0), rotation=np.eye(3), origin=(0, 0, 1.0), gates=2,
            gate_start=0.0, gate_path=1.0, estimator="track", scale=1.0)),
        "make_flux_planes": (sk.make_flux_planes, dict(
            count=2, axis=(0, 0, 1.0), right=(1.0, 0, 0), centre=(0, 0, 0), radius=1.0, polar=3, azimuth=2, scale=1.0)),
        "make_sun": (sk.make_sun, dict(direction=(0.5, 0, 1.0), down=(0, 0, 1.0), distance=1.0, sky=0.2, crest=0.1)),
        "make_records": (sk.make_records, dict(count=3, device="cpu")),
        "make_mixture": (sk.make_mixture, dict(count=2)),
        "phase_tables": (sk.make_phase_tables, dict(density=np.ones_like, device="cpu")),
        "profile_tables": (sk.profile_tables, dict(image=np.ones((3, 4)))),
        "interpolated": (sk.interpolated_density, dict(angles=[0.0, 1.0, 2.0], values=[3.0, 2.0, 1.0])),
        "fournier_forand": (sk.fournier_forand_density, dict(t=0.5, particle_index=1.1, junge_slope=3.6)),
        "henyey_greenstein": (sk.henyey_greenstein_density, dict(t=0.5, g=0.5)),
        "two_term": (sk.two_term_henyey_greenstein_density, dict(t=0.5, g1=0.5, g2=-0.1, alpha=0.9)),
        "near_depth_map": (near_depth_map, dict(mesh=mesh, camera=lit_box()["camera"])),
        "load_kernel": (sk.load_transport_kernel, dict(
            spec=sk.TransportSpec("next_event"), device="cpu")),
        "add_tallies": (sk.add_tallies, dict(total=tallies(), more=tallies())),
        "batches": (lambda close, **rest: sk.Batches(**rest).close(close), dict(
            tally=tallies(), component_count=3, total=None, close=tallies())),
        "read_ledger": (sk.read_ledger, dict(data=sk.make_data(model))),
        "first_photon": (sk.first_photon_counts, dict(**drawn, summed=False)),
        "events": (sk.event_counts, dict(
            **drawn, edges=np.linspace(0, 1e-7, 9), recorded=8, period=1e-6, dead_time=1e-8, tags=True, gated=False,
            afterpulsing_probability=0.1, afterpulsing_time_constant=1e-7)),
        "expected": (sk.expected_detections, dict(
            source=rows, row_start=np.array([0, 1, 2]), source_bin=np.array([0, 1]), weight=np.ones(2),
            width=np.ones(2), noise_rate=floats(6))),
        "dark_counts": (sk.dark_count_rates, dict(
            pixels=6, median=100.0, spread=0.1, hot_fraction=0.1, hot_rate=1e4, seed=0, device="cpu")),
        "crosstalk": (detection.add_crosstalk, dict(
            hazard=rows, detections=floats(6, 8), image_width=3, probability=0.1)),
        "first_law": (detection.first_photon_probabilities, dict(hazard=rows)),
        "free_running": (detection.free_running_probabilities, dict(hazard=rows, dead_time=1e-8, period=1e-6)),
        "coates": (detection.coates, dict(counts=counts, pulses=100)),
        "signal_map": (sk.signal_map, dict(
            lidar=_lidar(), view=view, distance=four(), normal=view, reflectance=four())),
        "scatter_table": (sk.single_scatter_table, scatter | dict(distance=four())),
        "statistics": (sk.statistics_maps, scatter | dict(
            profile=floats(1, 8), signal=four(), arrival=four(5e-8), backscatter=four(), count_law="per_pulse",
            acquisitions=100.0, pulses_per_frame=1.0)),
        "information": (analytic.histogram_information, dict(
            signal=rows, background=floats(1, 8), taps=taps, slope_taps=taps, first_photon=True)),
        "outliers": (analytic.outlier_probabilities, dict(signal_count=four(), level=four(), window=four())),
        "sample_frames": (sk.sample_frames, maps | dict(
            laser=(0, 0, 0), gate_paths=(1.0, 3.0), first_frame=0, frames=3, seed=1, out=None)),
        "draw_frames": (analytic.draw_frames, maps | dict(coding=coding, alpha=floats(4), fraction=floats(2))),
    }  # fmt: skip
    for method in ("peak", "centroid", "matched", "likelihood"):
        calls[f"arrival_{method}"] = (sk.arrival_bins, dict(histogram=counts, method=method, half_width=2, **bins))
    return calls | world_calls.valid_calls(mesh) | optics_calls.valid_calls(mesh)


_DTYPES = (float, int, wp.float64, wp.int64, wp.vec3, wp.vec3d, wp.vec4, wp.uint8, wp.bool)
_SHAPES = ((0,), (1,), (4,), (12,), (0, 0), (1, 8), (6, 8), (8, 6), (4, 12, 16), (6, 0), (0, 8))


def _changed(r, value):
    if r.random() < 0.12:
        return r.choice(JUNK + NUMBERS)
    if wp.types.is_struct(value):
        return _struct(r, value) if r.random() < 0.85 else type(value).__mro__[1]
    if isinstance(value, wp.array):
        return _array(r, value)
    if isinstance(value, np.ndarray):
        return _numpy(r, value)
    if isinstance(value, (sk.Model, sk.Data)):
        name = r.choice([one.name for one in dataclasses.fields(value)])
        return dataclasses.replace(value, **{name: _changed(r, getattr(value, name))})
    if isinstance(value, sk.TransportSpec):
        name = r.choice(value._fields)
        others = {"estimator": ("none", "analog", "guided", "x", 3), "phase": (sk.TABULATED, "x", None)}
        others["lens"] = (sk.CALIBRATED, None, "x")
        return value._replace(**{name: r.choice(others.get(name, (not getattr(value, name), "yes", None)))})
    if isinstance(value, PortKind):
        return r.choice((sk.DOME_PORT, None, *JUNK))
    if isinstance(value, (list, tuple)):
        items = list(value)
        if items and r.random() < 0.7:
            items[r.randrange(len(items))] = r.choice(NUMBERS + JUNK)
        else:
            items = items[:-1] if r.random() < 0.5 else [*items, 1.0]
        return type(value)(items)
    if value is None:
        return r.choice((_array(r), _array(r), wp.zeros(288, dtype=wp.int64, device="cpu"), 3))
    if callable(value):
        return r.choice((lambda t: t * np.nan, lambda t: 3, lambda t: -np.ones_like(t), lambda t: None, None))
    return r.choice(NUMBERS + JUNK)


def _array(r, like=None):
    if like is None or r.random() < 0.3:
        made = wp.zeros(r.choice(_SHAPES), dtype=r.choice(_DTYPES), device="cpu")
        return made.transpose() if made.ndim == 2 and r.random() < 0.2 else made
    if r.random() < 0.5:
        shape = list(like.shape)
        k = r.randrange(len(shape))
        shape[k] = r.choice((0, 1, 2, shape[k] + 1, max(shape[k] - 1, 0), 2 * shape[k]))
        return wp.zeros(tuple(shape), dtype=like.dtype, device="cpu")
    return wp.array(_numpy(r, like.numpy(), always=True), dtype=like.dtype, device="cpu")


def _numpy(r, like, *, always=False):
    if always and not like.size:
        return np.array(like)
    if not like.size or (not always and r.random() < 0.4):
        others = (np.zeros(0), np.zeros((0, 3)), np.zeros(3), np.zeros((2, 3, 4)), np.array(["a"]), np.full(9, np.nan))
        return r.choice(others)
    changed = np.array(like)
    flat = changed.reshape(-1)
    for _ in range(r.choice((1, 2, flat.size))):
        odd = r.choice((np.nan, np.inf, -1, 0, 1e30, 2**31 - 1, 100, -(2**31)))
        if flat.dtype.kind in "iub":
            lowest, highest = -(2**31) if flat.dtype.kind == "i" else 0, 2**31 - 1 if flat.itemsize > 2 else 1
            odd = int(np.clip(np.nan_to_num(odd), lowest, highest))
        flat[r.randrange(flat.size)] = odd
    return changed


def _struct(r, struct):
    made = type(struct)()
    for name in struct._cls.vars:
        if getattr(struct, name) is not None:
            setattr(made, name, getattr(struct, name))
    name = r.choice(sorted(struct._cls.vars))
    now = getattr(made, name)
    if wp.types.is_struct(now):
        odd = _struct(r, now)
    elif now is None or isinstance(now, wp.array):
        odd = r.choice((None, _array(r, now)))
    elif isinstance(now, int):
        odd = r.choice((0, -1, 1, 7, 2**31 - 1, -(2**31), 100_000))
    elif isinstance(now, float):
        odd = r.choice((0.0, -1.0, 1.5, math.nan, math.inf, -math.inf, 1e30, 1e-30))
    else:
        whole = isinstance(now, wp.vec3i)
        odd = type(now)(r.choice((0, 2, -1, 2**31 - 1) if whole else (0.0, 2.0, math.nan, math.inf, 1e30)))
    try:
        setattr(made, name, odd)
    except (TypeError, RuntimeError, ValueError):  # Warp refuses another dtype
        setattr(made, name, now)
    return made
