"""Monte Carlo transport of photons from a pulsed laser through water and against a mesh into a camera.

One kernel, specialised by a hashable `TransportSpec`. A thread walks photon after photon through a small state machine

    EMIT -> FLIGHT -> [FLIGHT_SAMPLE ->] EVENT -> SCATTER -> FLIGHT -> ... -> END -> EMIT

and leaves the inner loop only when it has a ray to trace, so that the BVH is walked by all threads of a warp at once.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import warp as wp

from .camera import Camera, LensSample, project, sample_lens
from .direction import one_minus_cosine, rotate_direction, sample_lambert, snap_direction
from .domain import Limits, exit_distance, exit_face
from .gate import Gate, gate_bin
from .guided import Guiding, clip_flight, sample_flight
from .laser import Laser, emit_photon
from .medium import Medium, free_path
from .phase import HENYEY_GREENSTEIN, PhaseFunction, henyey_greenstein_pdf, sample_henyey_greenstein
from .philox import STREAM_FLIGHT_SAMPLE, STREAM_ROULETTE, STREAM_TRANSPORT, random_block, u01, u01_fine
from .surface import intersect_mesh, lambert_brdf, offset_from_surface, segment_meets_box
from .tally import (
    ABSORBED_SURFACE,
    ABSORBED_WATER,
    CONTRIBUTIONS,
    DIRECTED,
    COUNTERS,
    LEDGER_ENTRIES,
    LEDGER_SLOTS,
    LEDGER_WIDTH,
    MAX_COLLISIONS,
    MAX_PATH,
    ROULETTE,
    SHADOW_QUERIES,
    SURFACE_EVENTS,
    SURFACE_QUERIES,
    WATER_COLLISIONS,
    WEIGHT_CUTOFF,
    add_to_ledger,
    deposit,
    to_ledger,
)
from .warp_lanes import count_lanes

ESTIMATORS = ("none", "analog", "next_event", "guided")

# What a history's events make of its light: the first axis of the tally.
COMPONENTS = ("ballistic", "forward_scattered", "backscatter")
BALLISTIC, FORWARD_SCATTERED, BACKSCATTER = (wp.constant(i) for i in range(3))

_EMIT, _FLIGHT, _FLIGHT_SAMPLE, _EVENT, _SCATTER, _END, _DONE = (wp.constant(i) for i in range(7))
_NO_RAY, _SURFACE_RAY, _SHADOW_RAY = (wp.constant(i) for i in range(3))


# The warp traces its rays when this many of its 32 lanes have one: fewer leave lanes idle in the BVH, more in the water.
WAITING_LANES = 20

# Registers a thread, without and with a mesh: fewer spill, more leave too few warps to hide latency.
MAX_REGISTERS = (80, 128)


class TransportSpec(NamedTuple):
    """Compile-time choices: the key of the kernel cache.

    Attributes:
        estimator: One of ESTIMATORS; "none" transports without a camera.
        phase: Phase function of the water.
        paper_albedo: Draw the albedo uniformly from [0, medium.albedo] at each collision.
        mesh: Trace rays against a mesh.
        bounded: Honour the domain and the lateral limit.
        roulette: Russian roulette in place of the weight cut-off.
        records: Write the terminal state of each photon.
    """

    estimator: str = "next_event"
    phase: PhaseFunction = HENYEY_GREENSTEIN
    paper_albedo: bool = False
    mesh: bool = True
    bounded: bool = False
    roulette: bool = False
    records: bool = False


@wp.struct
class Records:
    """Terminal states by photon; arrays of length 0 where they are not asked for.

    Attributes:
        position: Where the history ended [m].
        direction: Unit vector of its last flight.
        weight: Weight at the end.
        path: Geometric path [m].
        collisions: Events, surfaces included.
        reason: Ledger entry that took the rest of the weight.
    """

    position: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    weight: wp.array(dtype=float)
    path: wp.array(dtype=float)
    collisions: wp.array(dtype=int)
    reason: wp.array(dtype=int)


@wp.struct
class Surfaces:
    """The target: a `wp.Mesh` id, its padded bounding box [m], the reflectance of each face in [0, 1]."""

    mesh: wp.uint64
    lower: wp.vec3
    upper: wp.vec3
    reflectance: wp.array(dtype=float)


@wp.func
def next_event_value(
    camera: Camera, extinction: float, weight: float, scattering: float, to_lens: wp.vec3, distance: float
) -> float:
    """Fraction of the photon that reaches a point of the aperture: w f exp(-c r) A cos(psi)/r^2, f [1/sr], to_lens a unit vector."""
    cos_lens = wp.max(-to_lens[2], 0.0)
    return weight * scattering * wp.exp(-extinction * distance) * camera.aperture_area * cos_lens / (distance * distance)


@wp.func
def tally_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """Index into the tally [component, pixel, bin], or BEFORE or AFTER the gate."""
    k = gate_bin(gate, path)
    if k < 0:
        return k
    return (component * camera.width * camera.height + pixel) * gate.bins + k


@functools.cache
def make_transport_kernel(spec: TransportSpec, cuda: bool = False) -> wp.Kernel:
    """The transport kernel for a spec; launch grid: `thread_count` threads, photon i is walked by thread i mod thread_count.

    On CUDA `thread_count` must be a multiple of the block size, since whole warps vote.
    """
    if spec.estimator not in ESTIMATORS:
        raise ValueError(f"estimator = {spec.estimator!r} is not one of {', '.join(ESTIMATORS)}")
    analog = spec.estimator == "analog"
    next_event = spec.estimator == "next_event"
    guided = spec.estimator == "guided"
    paper_albedo, has_mesh, bounded, roulette, records = spec[2:]
    phase_pdf, phase_sample = spec.phase.pdf, spec.phase.sample
    waiting_lanes = WAITING_LANES if has_mesh else 32

    @wp.kernel(
        module="unique",
        module_options={"fast_math": cuda},
        enable_backward=False,
        cuda_max_registers=MAX_REGISTERS[has_mesh],
    )
    def transport(
        # Model:
        medium: Medium,
        laser: Laser,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        guiding: Guiding,
        surfaces: Surfaces,
        # Photons:
        seed: wp.uint64,
        first_id: wp.uint64,
        photon_count: int,
        thread_count: int,
        # Data out:
        scale: float,
        tally: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        out: Records,
    ):
        thread = wp.tid()
        stage = int(_EMIT)

        # State of the photon:
        photon = int(thread)
        x = wp.vec3(0.0)
        u = wp.vec3(0.0)
        weight = float(0.0)
        analog_weight = float(0.0)
        ledger_weight = wp.int64(0)
        path = float(0.0)
        collisions = int(0)
        surface_count = int(0)
        reason = int(0)  # ledger entry of the history's end
        # Its next event:
        block = wp.vec4ui()
        distance = float(0.0)  # to the end of the flight
        face = int(-1)  # hit there; -1 in the water
        normal = wp.vec3(0.0)
        albedo = float(medium.albedo)
        # The ray to trace, and the contribution that waits for it:
        ray = int(_NO_RAY)
        reach = float(0.0)
        interval = wp.vec2(0.0)  # of the flight that the camera sees
        along = float(0.0)  # point of the flight that is scored; 0 is x
        lens = LensSample()
        pending_index = int(0)
        pending_value = float(0.0)
        # What the thread has to tell:
        absorbed_water = wp.int64(0)
        absorbed_surface = wp.int64(0)
        directed = wp.int64(0)
        surface_queries = int(0)
        shadow_queries = int(0)
        contributions = int(0)

        while count_lanes(stage == _DONE) < 32:
            # ---- Water: until enough lanes of the warp have a ray to trace
            waiting = int(0)
            while waiting < wp.static(waiting_lanes):
                if stage == _EMIT:
                    if photon >= photon_count:
                        stage = _DONE
                    else:
                        x, u = emit_photon(laser, seed, first_id + wp.uint64(photon))
                        weight = 1.0
                        analog_weight = 1.0
                        ledger_weight = to_ledger(1.0)
                        path = 0.0
                        collisions = 0
                        surface_count = 0
                        stage = _FLIGHT

                if stage == _FLIGHT:
                    id = first_id + wp.uint64(photon)
                    block = random_block(seed, id, wp.uint32(collisions + 1), STREAM_TRANSPORT)
                    face = -1
                    distance = free_path(u01(block[0]), medium.extinction)
                    limit = limits.max_path - path
                    if wp.static(bounded):
                        limit = wp.min(limit, exit_distance(limits, x, u))
                    reach = wp.min(distance, limit)
                    if wp.static(paper_albedo):
                        draw = random_block(seed, id, wp.uint32(collisions + 1), STREAM_ROULETTE)
                        albedo = medium.albedo * u01(draw[1])
                    stage = _EVENT
                    if wp.static(guided):
                        lens = sample_lens(camera, seed, id, wp.uint32(2 * collisions + 2))
                        interval = clip_flight(camera, gate, x, u, path, lens.point, limit)
                        if interval[0] < interval[1] and medium.extinction > 0.0:
                            stage = _FLIGHT_SAMPLE
                            reach = wp.max(reach, interval[1])
                    if wp.static(has_mesh):
                        if segment_meets_box(x, u, reach, surfaces.lower, surfaces.upper):
                            ray = _SURFACE_RAY

                if wp.static(guided):
                    if stage == _FLIGHT_SAMPLE and ray == _NO_RAY:
                        stage = _EVENT
                        if interval[0] < interval[1]:
                            flight_block = random_block(
                                seed, first_id + wp.uint64(photon), wp.uint32(collisions + 1), STREAM_FLIGHT_SAMPLE
                            )
                            g = medium.anisotropy
                            sample = sample_flight(
                                x - lens.point,
                                u,
                                interval,
                                medium.extinction,
                                (1.0 - g) * (1.0 - g) / wp.max(g, 0.05),
                                u01(flight_block[0]),
                                u01_fine(flight_block[1]),
                            )
                            along = sample.s
                            y = x + along * u
                            pixel = project(camera, y)
                            if pixel >= 0 and sample.density > 0.0:
                                to_lens = (lens.point - y) / sample.r
                                t = one_minus_cosine(snap_direction(u, medium.axis_threshold), to_lens)
                                weight_there = weight * albedo * medium.extinction * wp.exp(-medium.extinction * along)
                                pending_value = (
                                    next_event_value(
                                        camera, medium.extinction, weight_there, phase_pdf(t, medium), to_lens, sample.r
                                    )
                                    / sample.density
                                )
                                component = wp.where(surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                                pending_index = tally_index(camera, gate, pixel, path + along + sample.r, component)
                                contributions += 1
                                ray = _SHADOW_RAY

                if stage == _EVENT and ray == _NO_RAY:
                    reason = -1
                    limit = limits.max_path - path
                    if wp.static(analog):
                        # Does the flight pass through the aperture, before anything else happens to it?
                        if u[2] < 0.0 and collisions > 0:
                            crossing = -x[2] / u[2]
                            on_lens = x + crossing * u
                            pixel = project(camera, x)
                            radius2 = on_lens[0] * on_lens[0] + on_lens[1] * on_lens[1]
                            inside = radius2 <= camera.aperture_radius * camera.aperture_radius
                            if pixel >= 0 and inside and crossing <= wp.min(distance, limit):
                                component = wp.where(surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                                if surface_count == 1 and collisions == 1:
                                    component = BALLISTIC
                                id = first_id + wp.uint64(photon)
                                contributions += 1
                                deposit(
                                    tally,
                                    ledger,
                                    thread,
                                    tally_index(camera, gate, pixel, path + crossing, component),
                                    weight,
                                    scale,
                                    sample_lens(camera, seed, id, wp.uint32(2 * collisions + 1)).dither,
                                )
                    if distance > limit:
                        reason = MAX_PATH
                    if wp.static(bounded):
                        out_distance = exit_distance(limits, x, u)
                        if out_distance < distance and out_distance <= limit:
                            reason = exit_face(limits, x, u)
                        limit = wp.min(limit, out_distance)
                    if reason >= 0:
                        x = x + limit * u
                        path += limit
                        stage = _END
                    else:
                        x = x + distance * u
                        path += distance
                        collisions += 1
                        stage = _SCATTER
                        if wp.static(has_mesh):
                            if face >= 0:
                                x = offset_from_surface(x, normal, distance)
                        if wp.static(next_event or guided):
                            # Water collisions are scored here by next_event alone: guided has scored the flight.
                            if wp.static(next_event) or face >= 0:
                                pixel = project(camera, x)
                                if pixel >= 0:
                                    id = first_id + wp.uint64(photon)
                                    lens = sample_lens(camera, seed, id, wp.uint32(2 * collisions + 1))
                                    to_lens = lens.point - x
                                    r = wp.length(to_lens)
                                    to_lens = to_lens / r
                                    scattering = float(0.0)
                                    component = int(FORWARD_SCATTERED)
                                    if face >= 0:
                                        cos_out = wp.max(wp.dot(to_lens, normal), 0.0)
                                        scattering = lambert_brdf(surfaces.reflectance[face]) * cos_out
                                        if collisions == 1:
                                            component = BALLISTIC
                                    else:
                                        snapped = snap_direction(u, medium.axis_threshold)
                                        scattering = albedo * phase_pdf(one_minus_cosine(snapped, to_lens), medium)
                                        if surface_count == 0:
                                            component = BACKSCATTER
                                    if scattering > 0.0:
                                        along = 0.0
                                        pending_value = next_event_value(
                                            camera, medium.extinction, weight, scattering, to_lens, r
                                        )
                                        pending_index = tally_index(camera, gate, pixel, path + r, component)
                                        contributions += 1
                                        ray = _SHADOW_RAY

                if wp.static(next_event or guided):
                    if ray == _SHADOW_RAY:
                        needed = False
                        if wp.static(has_mesh):
                            origin = x + along * u
                            needed = segment_meets_box(
                                origin, lens.point - origin, 1.0, surfaces.lower, surfaces.upper
                            )
                        if not needed:
                            deposit(tally, ledger, thread, pending_index, pending_value, scale, lens.dither)
                            ray = _NO_RAY

                if stage == _SCATTER and ray == _NO_RAY:
                    # The score took the photon as it arrived; now its weight, its end or its new direction.
                    survival = float(albedo)
                    if wp.static(has_mesh):
                        if face >= 0:
                            survival = surfaces.reflectance[face]
                    weight *= survival
                    analog_weight *= survival
                    after = to_ledger(weight)
                    if face >= 0:
                        absorbed_surface += ledger_weight - after
                        surface_count += 1
                    else:
                        absorbed_water += ledger_weight - after
                    ledger_weight = after

                    reason = -1
                    if analog_weight < limits.weight_cutoff or analog_weight <= 0.0:
                        reason = WEIGHT_CUTOFF
                        if wp.static(roulette):
                            id = first_id + wp.uint64(photon)
                            chance = u01(random_block(seed, id, wp.uint32(collisions), STREAM_ROULETTE)[0])
                            reason = ROULETTE
                            if chance < 0.1 and analog_weight > 0.0:
                                reason = -1
                                weight *= 10.0
                                analog_weight *= 10.0
                                after = to_ledger(weight)
                                add_to_ledger(ledger, thread, ROULETTE, ledger_weight - after)
                                ledger_weight = after
                    if reason < 0 and collisions >= limits.max_collisions:
                        reason = MAX_COLLISIONS

                    stage = _END
                    if reason < 0:
                        stage = _FLIGHT
                        on_surface = False
                        if wp.static(has_mesh):
                            on_surface = face >= 0
                        snapped = snap_direction(u, medium.axis_threshold)
                        if wp.static(guided):
                            # Towards the lens with some probability; the weight makes up for it.
                            v = -wp.normalize(x)
                            chance = wp.where(on_surface, guiding.surface_probability, guiding.probability)
                            axis = wp.where(u01(block[3]) < chance, v, snapped)
                            if u01(block[3]) >= chance and on_surface:
                                u = sample_lambert(normal, u01(block[1]), u01(block[2]))
                            else:
                                t = phase_sample(u01_fine(block[1]), medium)
                                if u01(block[3]) < chance:
                                    t = sample_henyey_greenstein(u01_fine(block[1]), guiding.anisotropy)
                                u = rotate_direction(axis, t, u01(block[2]))
                            density = phase_pdf(one_minus_cosine(snapped, u), medium)
                            if on_surface:
                                density = wp.max(wp.dot(u, normal), 0.0) * 0.3183098861837907
                            lobe = henyey_greenstein_pdf(one_minus_cosine(v, u), guiding.anisotropy)
                            weight *= density / wp.max((1.0 - chance) * density + chance * lobe, 1.0e-30)
                            after = to_ledger(weight)
                            directed += ledger_weight - after
                            ledger_weight = after
                            if weight <= 0.0:
                                reason = DIRECTED
                                stage = _END
                        else:
                            if on_surface:
                                u = sample_lambert(normal, u01(block[1]), u01(block[2]))
                            else:
                                u = rotate_direction(snapped, phase_sample(u01_fine(block[1]), medium), u01(block[2]))

                if stage == _END:
                    add_to_ledger(ledger, thread, reason, ledger_weight)
                    add_to_ledger(ledger, thread, WATER_COLLISIONS, wp.int64(collisions - surface_count))
                    if wp.static(has_mesh):
                        add_to_ledger(ledger, thread, SURFACE_EVENTS, wp.int64(surface_count))
                    if wp.static(records):
                        out.position[photon] = x
                        out.direction[photon] = u
                        out.weight[photon] = weight
                        out.path[photon] = path
                        out.collisions[photon] = collisions
                        out.reason[photon] = reason
                    photon += thread_count
                    stage = _EMIT

                waiting = count_lanes(ray != _NO_RAY or stage == _DONE)

            # ---- Surfaces: the warp traces its rays together
            if wp.static(has_mesh):
                if ray != _NO_RAY:
                    origin = x
                    to = u
                    length = reach
                    if wp.static(next_event or guided):
                        if ray == _SHADOW_RAY:
                            origin = x + along * u
                            to = lens.point - origin
                            length = wp.length(to)
                            to = to / length
                    hit = intersect_mesh(surfaces.mesh, origin, to, length)
                    if ray == _SURFACE_RAY:
                        surface_queries += 1
                        if hit.face >= 0:
                            if wp.static(guided):
                                interval = wp.vec2(interval[0], wp.min(interval[1], hit.distance))
                            if hit.distance < distance:
                                distance = hit.distance
                                face = hit.face
                                normal = hit.normal
                    else:
                        shadow_queries += 1
                        if hit.face < 0:
                            deposit(tally, ledger, thread, pending_index, pending_value, scale, lens.dither)
                    ray = _NO_RAY

        add_to_ledger(ledger, thread, ABSORBED_WATER, absorbed_water)
        add_to_ledger(ledger, thread, ABSORBED_SURFACE, absorbed_surface)
        add_to_ledger(ledger, thread, DIRECTED, directed)
        add_to_ledger(ledger, thread, SURFACE_QUERIES, wp.int64(surface_queries))
        add_to_ledger(ledger, thread, SHADOW_QUERIES, wp.int64(shadow_queries))
        add_to_ledger(ledger, thread, CONTRIBUTIONS, wp.int64(contributions))

    return transport


@dataclass(frozen=True)
class Model:
    """What is transported through: immutable, on one device.

    Attributes:
        device: Warp device that holds the arrays.
        medium, laser, camera, gate, limits, guiding: Parameter structs.
        mesh: Target, or None for water alone; kept here so that its BVH lives as long as the model.
        surfaces: The struct that kernels take, made from the mesh by `make_surfaces`.
        scale: Tally units per emitted photon.
    """

    device: wp.Device
    medium: Medium
    laser: Laser
    camera: Camera
    gate: Gate
    limits: Limits
    guiding: Guiding
    mesh: wp.Mesh | None
    surfaces: Surfaces
    scale: float

    @property
    def tally_size(self) -> int:
        return len(COMPONENTS) * self.camera.width * self.camera.height * self.gate.bins


@dataclass
class Data:
    """What transport writes: mutable, on one device; several launches may add to one.

    Attributes:
        tally: int64 [component * height * width * bin], fixed point.
        ledger: int64 [LEDGER_WIDTH * LEDGER_SLOTS]; the sum over slots is the ledger, see `read_ledger`.
        records: Terminal states of the last launch's photons.
    """

    tally: wp.array
    ledger: wp.array
    records: Records


def make_data(model: Model, *, tally: wp.array | None = None, record_count: int = 0) -> Data:
    """Zeroed tallies for a model, or the caller's own int64 array of `model.tally_size` to add to."""
    size = model.tally_size
    if tally is None:
        tally = wp.zeros(size, dtype=wp.int64, device=model.device)
    elif tally.dtype is not wp.int64 or tally.size != size or not tally.is_contiguous or tally.ndim != 1:
        raise ValueError(f"tally is {tally.dtype.__name__} {tally.shape}; contiguous int64 ({size},) is needed")
    return Data(
        tally=tally,
        ledger=wp.zeros(LEDGER_SLOTS * LEDGER_WIDTH, dtype=wp.int64, device=model.device),
        records=make_records(record_count, device=model.device),
    )


def make_records(count: int, *, device: wp.DeviceLike = None) -> Records:
    """Room for the terminal states of `count` photons."""
    records = Records()
    records.position = wp.zeros(count, dtype=wp.vec3, device=device)
    records.direction = wp.zeros(count, dtype=wp.vec3, device=device)
    records.weight = wp.zeros(count, dtype=float, device=device)
    records.path = wp.zeros(count, dtype=float, device=device)
    records.collisions = wp.zeros(count, dtype=int, device=device)
    records.reason = wp.zeros(count, dtype=int, device=device)
    return records


def make_surfaces(mesh: wp.Mesh | None, reflectance: wp.array | float = 0.5, *, device: wp.DeviceLike = None) -> Surfaces:
    """The kernel's view of a mesh.

    Args:
        mesh: Any `wp.Mesh`; None for no surface at all.
        reflectance: Lambertian, in [0, 1]: one number or a float32 array with one entry a face.
        device: Where the empty arrays go if there is no mesh.
    """
    surfaces = Surfaces()
    if mesh is None:
        surfaces.reflectance = wp.zeros(0, dtype=float, device=device)
        return surfaces
    face_count = mesh.indices.size // 3
    if isinstance(reflectance, float):
        reflectance = wp.full(face_count, reflectance, dtype=float, device=mesh.device)
    if reflectance.size != face_count:
        raise ValueError(f"reflectance has {reflectance.size} entries; the mesh has {face_count} faces")
    points = mesh.points.numpy()
    lower, upper = points.min(axis=0), points.max(axis=0)
    padding = 1e-6 * abs(points).max() + 1e-6
    surfaces.mesh = mesh.id
    surfaces.lower = wp.vec3(*(lower - padding))
    surfaces.upper = wp.vec3(*(upper + padding))
    surfaces.reflectance = reflectance
    return surfaces


# Threads of a CUDA launch: enough to fill any GPU, few enough that each walks many photons and flushes its tallies seldom.
CUDA_THREADS = 1 << 19


def transport(spec: TransportSpec, model: Model, data: Data, *, seed: int, first_id: int, photon_count: int) -> None:
    """Walks the photons first_id ... first_id + photon_count - 1 and adds them to `data`; asynchronous on CUDA.

    Args:
        spec: Compile-time choices; each new one compiles a kernel (seconds), cached on disk.
        model, data: On the same device.
        seed: 0 ... 2^64 - 1. A photon's history depends on (seed, id) alone.
        first_id: 64-bit.
        photon_count: 1 ... 2^26 in one launch.
    """
    if not 0 < photon_count <= 1 << 26:
        raise ValueError(f"photon_count = {photon_count} is outside [1, 2^26]")
    block = 128
    threads = min(-(-photon_count // block) * block, CUDA_THREADS) if model.device.is_cuda else 1
    wp.launch(
        make_transport_kernel(spec, model.device.is_cuda),
        dim=threads,
        inputs=[
            model.medium,
            model.laser,
            model.camera,
            model.gate,
            model.limits,
            model.guiding,
            model.surfaces,
            seed,
            first_id,
            photon_count,
            threads,
            model.scale,
        ],
        outputs=[data.tally, data.ledger, data.records],
        device=model.device,
        block_dim=block,
    )


def read_ledger(data: Data) -> tuple[dict[str, int], dict[str, int]]:
    """Ledger entries (units of LEDGER_UNIT photon) and counters summed over slots; waits for the device."""
    totals = data.ledger.numpy().reshape(LEDGER_WIDTH, LEDGER_SLOTS).sum(axis=1)
    names = LEDGER_ENTRIES + COUNTERS
    values = {name: int(total) for name, total in zip(names, totals, strict=True)}
    return {n: values[n] for n in LEDGER_ENTRIES}, {n: values[n] for n in COUNTERS}
