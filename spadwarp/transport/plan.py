"""The plan of a run: scene, seed, photon ids, batches, the unit of its tallies, and how its work is divided."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.mesh import TriangleMesh, build_mesh, focus_distance
from spadwarp.result import Result, ResultLike
from spadwarp.result.file import difference
from spadwarp.result.photon_ids import count, shard_of
from spadwarp.result.result import ResultHead
from spadwarp.scene import Laser, Scene, Transport
from spadwarp.scene.camera import to_camera
from spadwarp.scene.laser import load_profile, profile_extent
from spadwarp.scene.scan import shots_of
from spadwarp.scene.scene import camera_port
from spadwarp.scene.sections import field_range
from spadwarp.scene.sight import nearest_points, view_planes
from spadwarp.transport.derivatives import resolve_derivatives
from spadwarp.values import SEED, ConfigError, check_integer, check_part, check_real

__all__ = ["PHOTON_CAPACITY", "RunOptions", "TallyLimits", "tally_limits"]

# Photons in one launch: large enough to fill the device, small enough for progress and Ctrl-C.
LAUNCH_SIZE = {"cpu": 1 << 16, "cuda": 1 << 26}
# One CPU thread walks a whole launch, and counts its events in 32 bits.
LARGEST_LAUNCH = {"cpu": 1 << 20, "cuda": 1 << 26}

_PHOTONS = field_range(Transport, "photons")
_RANGES = {"threads": "[1, 4096]", "launch_size": f"[1, {1 << 26}]", "first_photon": f"[0, {1 << 62}]"}

# Voxels that are read at the end of a batch for each of its photons, at most: 2 % of a photon's time, on a GPU too.
_VOXELS_PER_PHOTON = 16

# Batches of a run: the least that tell an error, and at most as many as large histograms allow; half as many again, or
# twice, since their size is a power of two. With a stopping rule more, so that it can act early.
_BATCHES, _STOPPING_BATCHES = (8, 32), (128, 1024)
# A GPU stands still for 2 ms between batches (H200), 3 % of the time of so many photons.
_GPU_BATCH = 1 << 26

# Photons of a batch at most: a second or some, so that checkpoints can stand between them and devices share the work.
_LARGEST_BATCH = {"cpu": 1 << 20, "cuda": 1 << 30}

# Where the error decides about the number of photons: of a batch at least, and voxels read for each.
_AUTO_BATCH = {"cpu": 1 << 15, "cuda": 1 << 25}
_AUTO_VOXELS_PER_PHOTON = {"cpu": 128, "cuda": 16}

# Bins of all pixels, at most, whose errors are kept: in memory they take 88 bytes each, without errors 24.
MOST_BINS_WITH_ERRORS = 1 << 27
# Of a scan along a trajectory: 20 000 shots of 800 bins. Each shot has few photons of its own, and what its counts are
# drawn from is noisy beside their shot noise or not whatever its errors; 1e5 shots of 500 bins take 1.2 GB without.
_MOST_BINS_OF_SHOTS = 1 << 24


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How the photons of a run are divided, and what of the run is on disk; no choice changes the bits of a photon.

    Raises `ArgumentError`: a number out of range.
    """

    threads: int | None = None  # CPU threads; by default one a core; a GPU takes none
    launch_size: int | None = None
    """Photons in one launch, up to 2^26, on the CPU 2^20; by default what suits the device."""
    first_photon: int = 0  # id of the first photon; runs with disjoint ids can be added by `merge`
    shard: tuple[int, int] | None = None
    """(3, 64) for the third of 64 equal parts of the photons, which `merge` makes whole."""
    resume: ResultLike | None = None
    """A result of the same scene, or its path, to which photons are added until it has `photons`; the outcome is that
    of one long run. Gaps in its ids are filled."""
    checkpoint: str | Path | None = None
    """A file for the photons done so far, as a partial result that `resume` takes. It is not removed when the run is
    done."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints, at least; more where writing takes long, so that it costs 2 % of the time at
    most."""

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            "checkpoint_every": check_real("checkpoint_every", self.checkpoint_every, "[0, inf] s")
        }
        for name, within in _RANGES.items():
            value = getattr(self, name)
            checked[name] = None if value is None and name != "first_photon" else check_integer(name, value, within)
        checked["shard"] = None if self.shard is None else check_part("shard", self.shard)
        vars(self).update(checked)


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan(ResultHead):
    """The head of a run's result, in a form that can be sent to other processes, and how it is traced: with which mesh
    and derivatives by their full names; None as `launch_size` is what suits the device."""

    mesh: TriangleMesh | None
    derivatives: tuple[str, ...] = ()
    launch_size: int | None = None
    is_auto: bool = False  # whether the error decides how many of the `photons` are traced

    @property
    def scale(self) -> float:
        """Tally units per emitted photon."""
        return 1.0 / self.unit


def make_plan(
    scene: Scene,
    run: RunOptions,
    *,
    photons: int | Literal["auto"] | None,
    seed: int | None,
    batches: bool = True,
    kind: Literal["cpu", "cuda"] = "cpu",
    relative_error: float | None = None,
    resume: Result | None = None,
    derivatives: Iterable[str] | None = None,
    blocks: Sequence[int] | None = None,
) -> Plan:
    """The plan for the arguments of `simulate`; `resume` is that of the run, read. `batches`: whether errors and hashes
    of the files are kept, for which a run whose light alone is wanted has no use; `kind` of the devices.

    Raises `ArgumentError` for those that are out of range, `ConfigError` for those that cannot be combined.
    """
    if photons is not None and photons != "auto":
        photons = check_integer("photons", photons, _PHOTONS)
    seed = None if seed is None else check_integer("seed", seed, SEED)
    first_photon, shard, batch_size = run.first_photon, run.shard, 0
    if relative_error is not None:
        check_real("relative_error", relative_error, "(0, 1)")
    names = () if derivatives is None else resolve_derivatives(scene, derivatives, blocks)
    if resume is not None:
        _check_resumed(resume, run, seed)
        seed, first_photon, batches = resume.seed, resume.requested[0], resume.batch_size > 0
        photons = count([resume.requested]) if photons is None else photons
        had = tuple(resume.derivatives)
        if derivatives is not None and names != had:
            text = f"the run to resume has {', '.join(had) or 'none'}, not {', '.join(names)}"
            raise ConfigError(f"derivatives: {text}")
        names = had
    photons = scene.transport.photons if photons is None else photons
    mesh = build_mesh(scene)
    scale, capacity = tally_limits(scene, mesh)
    most = min(capacity, int(_PHOTONS.high))
    # A run by its error is interrupted with all the photons that there can be still asked for.
    is_auto = photons == "auto" or (resume is not None and photons == most)
    photons = most if photons == "auto" else photons
    if resume is not None and photons <= resume.photons:
        raise ConfigError(f"photons = {photons} is outside [{resume.photons + 1}, {10**12}]")
    if shard is not None and (is_auto or relative_error is not None):
        goal = "photons = 'auto'" if is_auto else "relative_error"
        raise ConfigError(f"{goal} cannot be combined with shard: no part knows the error of the whole")
    if batches:
        wanted = _batch_size(scene, None if is_auto else photons, relative_error, shard, kind)
        batch_size = max(0 if resume is None else resume.batch_size, wanted)
    if is_auto and not batch_size:
        raise ConfigError("photons = 'auto' needs errors, which a histogram this large does not keep; give a number")
    if photons > capacity:
        raise ConfigError(
            f"photons = {photons} is outside [1, {capacity}]: the unit of this scene's histogram is fine enough for "
            "its furthest target, and more photons might overflow its brightest bin; average runs with other seeds "
            "instead, or start the gate later"
        )
    ids = first_photon, first_photon + photons
    ids = ids if shard is None else shard_of(ids, shard, batch_size or 1)
    plan = Plan(
        scene=scene,
        unit=1.0 / scale,
        photons=count([ids]),
        seed=scene.transport.seed if seed is None else seed,
        energy_balance_unit=sk.LEDGER_UNIT,
        photon_ranges=(ids,),
        batch_size=batch_size,
        requested=ids,
        focus_distance=focus_distance(scene, mesh),
        file_hashes=scene.file_hashes() if batches else (),
        mesh=mesh,
        derivatives=names,
        launch_size=run.launch_size,
        is_auto=is_auto,
    )
    if resume is not None and (problem := difference(resume, plan)):
        raise ConfigError(f"resume: {problem}")
    return plan


def _batch_size(
    scene: Scene, photons: int | None, relative_error: float | None, shard: tuple[int, int] | None, kind: str
) -> int:
    """A power of two, times the positions of a scan so that every batch has whole rounds of it; 0: no batches.

    Where the number of photons is not known, None, some hundredths of a second.
    """
    bins = scene.camera.width * scene.camera.height * scene.gate.bins + sum(section.size for section in scene.flux)
    most_bins = _MOST_BINS_OF_SHOTS if scene.scan.mode == "trajectory" else MOST_BINS_WITH_ERRORS
    if bins > most_bins and (photons is None or relative_error is None):
        return 0
    positions, voxels = scene.scan_positions, len(scene.components) * bins
    if photons is None:
        least = max(_AUTO_BATCH[kind], voxels // _AUTO_VOXELS_PER_PHOTON[kind])
        return positions << max(0, (least // positions - 1).bit_length())
    fewest, most = _BATCHES if relative_error is None else _STOPPING_BATCHES
    if kind == "cuda" and relative_error is None:
        most = min(max(photons // _GPU_BATCH, fewest), most)
    least = min(max(photons * _VOXELS_PER_PHOTON // voxels, fewest), most)
    least = least if shard is None else max(least, shard[1])
    return positions * min(1 << max(0, (photons // positions // least).bit_length() - 1), _LARGEST_BATCH[kind])


def _check_resumed(resume: Result, run: RunOptions, seed: int | None) -> None:
    for name in ("first_photon", "shard"):
        if value := getattr(run, name):
            raise ConfigError(f"{name} = {value} cannot be combined with resume, which has the photon ids of its run")
    if seed not in (None, resume.seed):
        raise ConfigError(f"seed = {seed} is not {resume.seed}, the seed of the run to resume")
    if channel := resume.provenance.get("channel"):
        raise ConfigError(f"resume: the result holds light of channel {channel} alone; resume the run that it is of")


# The unit of the tallies, between the brightest bin that they hold and the faintest light that they resolve

PHOTON_CAPACITY = 2**40
"""Photons that a tally holds, where the faintest light does not ask for a finer unit; else `TallyLimits.photons`, at
least 1/16 of it."""

_LEAST_CAPACITY = 2**36

# A single contribution of the faintest light has this many units at least, if the least capacity allows it: rounding
# adds 2 % to the variance then.
_FAINT_UNITS = 4.0

_LARGEST_BIN = 2.0**62


class TallyLimits(NamedTuple):
    """What a scene's tally is made for."""

    scale: float  # tally units per emitted photon, a power of two
    photons: int  # in all parts of a run together, that keep the brightest bin below 2^62


def tally_limits(scene: Scene, mesh: TriangleMesh | None) -> TallyLimits:
    """The unit of a scene's tally and the photons that it holds: functions of the scene alone, so that parts of a run
    add up.

    From both ends: `PHOTON_CAPACITY` photons keep the brightest bin below 2^62; or fewer, down to 1/16, where a finer
    unit is needed to resolve the faintest light, the next event of one photon on the furthest target.
    """
    if scene.transport.estimator == "none":
        return TallyLimits(1.0, PHOTON_CAPACITY)
    density = _phase_density(scene)
    brightest, faintest = (min(max(bound(scene, mesh, density), 1e-30), 1.0) for bound in (_brightest, _faintest))
    coarsest, finest = (
        math.floor(math.log2(_LARGEST_BIN / (photons * brightest))) for photons in (PHOTON_CAPACITY, _LEAST_CAPACITY)
    )
    wanted = math.ceil(math.log2(_FAINT_UNITS / faintest))
    # Finer than 2^-52, light that by chance scatters right before the lens would not fit into one contribution.
    scale = 2.0 ** min(max(coarsest, min(wanted, finest)), 52)
    return TallyLimits(scale, min(PHOTON_CAPACITY, int(_LARGEST_BIN / (brightest * scale))))


Density = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def _own_anisotropies(scene: Scene) -> list[float]:
    """Of layers and cells that share the phase function's form alone."""
    return [] if scene.medium.has_phase_table else list(scene.medium.range.anisotropies)


def _phase_density(scene: Scene) -> Density:
    """Largest density [1/sr] of the phase functions of a scene's waters over t = 1 - cos(angle) in (0, 2]."""
    laws: list[Density] = [law.over_t for law in scene.medium.phase_functions]
    laws += [partial(sk.henyey_greenstein_density, g=g) for g in _own_anisotropies(scene)]
    return lambda t: np.max([law(t) for law in laws], axis=0)


def _backward(scene: Scene, density: Density) -> float:
    """Density [1/sr] with which light is thrown back: the largest of the phase function beyond 90°, or what many
    small deflections come to, isotropic scattering of (1 - <cos>) times the light."""
    turned = 1.0 - min([*(law.mean_cosine for law in scene.medium.phase_functions), *_own_anisotropies(scene)])
    return max(float(density(np.linspace(1.0, 2.0, 181)).max()), turned / (4.0 * math.pi))


def _faintest(scene: Scene, mesh: TriangleMesh | None, density: Density) -> float:
    """Next event of a photon of full weight at the far end of the scene: on the furthest target, or in the water."""
    furthest = 0.5 * scene.path_limit
    scattered = max(scene.medium.range.albedo, 1e-3) * float(density(np.array([2.0]))[0])
    if mesh is not None:
        reaches = [np.linalg.norm(np.abs(mesh.bounds - lens).max(axis=0)) for lens in _lens_positions(scene)]
        furthest = min(furthest, float(max(reaches)))
        scattered = max(float(mesh.reflectance.max()), 1e-3) / math.pi
    above = camera_port(scene) if scene.surface is not None else None
    begin = 0.0 if above is None else min(above.distance, furthest)
    through = math.exp(-scene.optical_depth([0.0, 0.0, begin], [0.0, 0.0, furthest]))
    return scattered * through * scene.camera.aperture_area / furthest**2


def _brightest(scene: Scene, mesh: TriangleMesh | None, density: Density) -> float:
    """The brightest bin's share of the light.

    It is bounded from above by the lidar equation at the near end of the gate, for light scattered back in the water,
    or off the nearest point of a target, all of it within one bin, shared by the pixels that the beam spans; for a
    laser away from the lens also where its beam, narrow near its exit, crosses the view, and for light that scatters
    into the view before the beam reaches it. Times 16 for multiple scattering, and lost by absorption alone, since what
    scatters may still arrive.
    """
    camera, laser, gate, medium = scene.receiver, scene.beam, scene.gate, scene.medium
    speed = medium.pulse_speed
    pixels = camera.width * camera.height
    half_field = 0.5 * camera.width * camera.pixel_tangent
    lenses = _lens_positions(scene)
    spread = _spread(laser)
    # Each position of a scan has its own part of the photons.
    share = scene.scan_positions

    def illuminated_pixels(spot_scale: float) -> float:
        """Pixels that share the beam, for a spot of `spot_scale` times its size as seen from the lens's distance."""
        spot = max(math.pi * (spread * spot_scale / camera.pixel_tangent) ** 2, 1.0)
        return share * spot if share > 1 else min(spot, pixels)

    baseline = math.hypot(laser.position[0], laser.position[1])
    nearest = max(0.5 * gate.start * speed, baseline / (half_field + spread), camera.aperture_radius, 0.01)
    if (port := camera_port(scene)) is not None:
        nearest = max(nearest, port.nearest - float((lenses @ port.normal).max()))
    scattering, absorption = medium.range.scattering, medium.range.absorption
    reach = 0.5 * gate.bin_width * speed
    # The integral of 1/r^2 over the bin.
    backward = scattering * _backward(scene, density) * reach
    water = backward / (nearest * (nearest + reach))
    surface, bistatic = 0.0, _crossing(scene, illuminated_pixels, density)
    if mesh is not None:
        gap = min(_distance(lens, mesh) for lens in lenses)
        white = 1.0
        if mesh.specular is not None and mesh.roughness is not None:
            # A lobe is brighter than white by the density of its facets, 1/(4 alpha^2) times their reflectance.
            white = max(1.0, float((mesh.reflectance + 0.25 * mesh.specular / mesh.roughness**2).max()))
        surface = white / (math.pi * max(gap, nearest) ** 2)
        if math.hypot(*laser.position) > 0.25 * gap:
            thrown = min(_distance(lens + laser.position, mesh) for lens in lenses)
            spot = illuminated_pixels(min(1.0, thrown / max(gap, 1e-3)))
            through = math.exp(-absorption * (gap + thrown))
            bistatic = max(bistatic, white * through / (math.pi * max(gap, camera.aperture_radius, 0.01) ** 2 * spot))
    coaxial = max(water, surface) * math.exp(-absorption * 2.0 * nearest) / illuminated_pixels(1.0)
    aside = 0.0
    if baseline > camera.aperture_radius:
        view = min(4.0 * half_field**2 * camera.height / camera.width, 2.0 * math.pi) / (4.0 * math.pi)
        longest = max(gate.start * speed, baseline)
        aside = min(scattering * baseline, 1.0) * backward * view * math.exp(-absorption * longest) / baseline**2
        aside /= share if share > 1 else pixels
    return 16.0 * camera.aperture_area * max(coaxial, bistatic, aside)


_MOST_LENSES = 64


def _lens_positions(scene: Scene) -> NDArray[np.float64]:
    """Where the lens is, in the camera's frame [m] `[N, 3]`: at its origin, or at some of the shots of a trajectory."""
    if scene.scan.mode != "trajectory":
        return np.zeros((1, 3))
    shots = shots_of(scene)
    chosen = np.unique(np.linspace(0, len(shots) - 1, _MOST_LENSES).astype(int))
    return to_camera(scene.camera, shots.position[chosen])


def _distance(point: NDArray[np.float64], mesh: TriangleMesh) -> float:
    """From a point to the nearest face [m]."""
    vertices, faces = mesh.vertices - point.astype(np.float32), mesh.faces
    nearest = (vertices**2).sum(axis=1).min()
    corners = [vertices[faces[:, k]] for k in range(3)]
    # The boxes about the faces leave few of them.
    box = np.maximum(np.minimum.reduce(corners), -np.maximum.reduce(corners)).clip(min=0.0)
    near = vertices[faces[(box**2).sum(axis=1) <= 1.001 * nearest]].astype(np.float64)
    return float(np.linalg.norm(nearest_points(near, np.zeros(3)), axis=1).min())


def _spread(laser: Laser) -> float:
    """Tangent of the half angle of an even cone that is as bright as the beam; 0 for a parallel one."""
    if laser.profile == "collimated":
        return 0.0
    if laser.profile == "measured":
        image = load_profile(laser)
        wide, tall = profile_extent(laser)
        return math.sqrt(4.0 * wide * tall * float(image.mean() / image.max()) / math.pi)
    return math.tan(min(laser.half_angle, 1.5))


def _crossing(scene: Scene, illuminated_pixels: Callable[[float], float], density: Density) -> float:
    """Largest share of the light per area of the lens [1/m^2] that one bin of one pixel gets where the beam's axis is
    in view, by single scattering; 0 if it never is, or starts at the lens."""
    camera, laser, gate, medium = scene.camera, scene.beam, scene.gate, scene.medium.range
    speed = scene.medium.pulse_speed
    exit_point = np.array(laser.position)
    if np.linalg.norm(exit_point) < camera.aperture_radius or scene.scan_positions > 1:
        return 0.0
    along = np.geomspace(1e-3, max(scene.path_limit, 2e-3), 400)
    points = exit_point + along[:, None] * np.array(laser.axis)
    away = np.linalg.norm(points, axis=1)
    planes = view_planes(camera)
    seen = (points @ planes[:, :3].T + planes[:, 3] >= 0.0).all(axis=1)
    seen &= (along + away >= gate.start * speed) & (along + away <= gate.stop * speed)
    points, away, along = points[seen], away[seen], along[seen]
    one_minus_cosine = 1.0 + points @ np.array(laser.axis) / away
    # A peak that is narrower than half the lens lights a part of it.
    phase = density(np.clip(one_minus_cosine, 0.5 * (0.25 * camera.aperture_radius / away) ** 2, 2.0))
    # The part of the beam that arrives within a bin; light that comes straight at the lens arrives all at once.
    part = np.minimum(gate.bin_width * speed / np.maximum(one_minus_cosine, 1e-6), along + away)
    away = np.maximum(away, max(camera.aperture_radius, 0.01))
    light = medium.scattering * part * phase * np.exp(-medium.absorption * (along + away)) / away**2
    return float((light / [illuminated_pixels(scale) for scale in along / away]).max(initial=0.0))
