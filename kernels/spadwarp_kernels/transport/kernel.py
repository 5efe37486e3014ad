"""Monte Carlo transport of photons from a pulsed laser through water and against a mesh into a camera.

One kernel, specialised by a hashable `TransportSpec`. A thread walks photon after photon through a small state machine

    FLIGHT -> EVENT -> SCATTER -> FLIGHT -> ... -> END

and leaves the inner loop only when it has a ray to trace, so that the BVH is walked by all threads of a warp at once.
A warp emits 32 photons at a time and stocks them; a thread whose photon has ended takes the next.
"""

import functools
from typing import NamedTuple

import warp as wp

from spadwarp_kernels.estimators.contribution import (
    BACKSCATTER,
    BALLISTIC,
    FORWARD_SCATTERED,
    Request,
    make_gathering,
    make_score,
    tally_index,
)
from spadwarp_kernels.intersect.bvh import (
    FINISHED,
    Stack,
    face_distance,
    face_in,
    face_normal,
    inverse_direction,
    walk_node,
)
from spadwarp_kernels.math.rotations import one_minus_cosine, rotate_direction, sample_cosine_law, snap_direction
from spadwarp_kernels.medium.layers import HOMOGENEOUS, LAYERED, Layers
from spadwarp_kernels.medium.limits import (
    Limits,
    exit_distance,
    exit_distance_rotated,
    exit_face,
    exit_face_rotated,
    is_outside,
    is_outside_rotated,
)
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.phase.henyey_greenstein import (
    HENYEY_GREENSTEIN,
    HENYEY_GREENSTEIN_GUIDE,
    henyey_greenstein_pdf,
    sample_henyey_greenstein,
)
from spadwarp_kernels.phase.phase_function import Guiding, PhaseFunction
from spadwarp_kernels.photon.lanes import (
    COUNT_PLACES,
    SET_PLACES,
    TAKE_PLACE,
    count_lanes,
    count_lanes_before,
    exchange,
    places,
    take_photons,
)
from spadwarp_kernels.random.philox import (
    STREAM_FLIGHT_SAMPLE,
    STREAM_ROULETTE,
    STREAM_SURFACE,
    STREAM_TRANSPORT,
    RoundKeys,
    random_block_keyed,
    u01,
    u01_fine,
    u01_last,
)
from spadwarp_kernels.sensor.camera import Camera, lens_point
from spadwarp_kernels.sensor.gate import Gate, clip_to_gate
from spadwarp_kernels.sensor.projection import PINHOLE, Lens
from spadwarp_kernels.source.laser import Laser, emit_along, emit_measured
from spadwarp_kernels.source.scan import Scan
from spadwarp_kernels.surface.ggx import reflection_pdf, sample_reflection, unshadowed
from spadwarp_kernels.surface.mesh import (
    Surfaces,
    face_reflectance,
    intersect_faces,
    intersect_surfaces,
    offset_from_surface,
    pattern_reflectance,
    segment_meets_box,
)
from spadwarp_kernels.tally.tally import (
    ABSORBED_SURFACE,
    ABSORBED_WATER,
    CONTRIBUTIONS,
    DIRECTED,
    MAX_COLLISIONS,
    MAX_PATH,
    ROULETTE,
    SHADOW_QUERIES,
    SURFACE_EVENTS,
    SURFACE_QUERIES,
    WATER_COLLISIONS,
    WEIGHT_CUTOFF,
    add_to_ledger,
    atomic_add_int64,
    deposit,
    to_ledger,
)

ESTIMATORS = ("none", "analog", "next_event", "guided")

_FLIGHT, _EVENT, _SCATTER, _START, _END, _DONE = (wp.constant(i) for i in range(6))
_NO_RAY, _SURFACE_RAY, _SHADOW_RAY = (wp.constant(i) for i in range(3))


# A warp traces rays when this many of its 32 lanes wait for one, or have ended: fewer leave lanes idle in the BVH, more
# in the water.
RAY_LANES = 20

# It goes back to the water when fewer than this many still walk down the tree, and lets them wait for company.
WALKING_LANES = 8

# It takes new photons when this many lanes have ended.
START_LANES = 3

# Meshes of at most this many faces need no BVH.
BRUTE_FORCE_FACES = 12

# Registers a thread, without and with a BVH: fewer spill, more leave too few warps to hide latency.
MAX_REGISTERS = {"none": (56, 64), "analog": (64, 64), "next_event": (64, 64), "guided": (96, 72)}


class TransportSpec(NamedTuple):
    """Compile-time choices: the key of the kernel cache.

    Attributes:
        estimator: One of ESTIMATORS; "none" transports without a camera.
        phase: Phase function of the water.
        random_albedo: Draw the albedo uniformly from [0, medium.albedo] at each collision.
        mesh: Trace rays against a mesh.
        brute_force: On CUDA, try every face rather than walk the tree; for meshes of up to BRUTE_FORCE_FACES faces.
        bounded: Honour the domain and the lateral limit.
        roulette: Russian roulette in place of the weight cut-off.
        records: Write the terminal state of each photon.
        layered: The water is that of the layers, not that of the medium.
        pattern: The reflectance varies within faces: corners and textures.
        specular: Faces have a rough specular lobe beside the Lambertian one.
        lens: How the camera images.
        measured_beam: Emit from the laser's measured profile.
        confocal: Beam and pixel scan together: each photon has a beam axis and a pixel of its own. Needs CALIBRATED.
        rotated_domain: The domain has axes of its own.
    """

    estimator: str = "next_event"
    phase: PhaseFunction = HENYEY_GREENSTEIN
    random_albedo: bool = False
    mesh: bool = True
    brute_force: bool = False
    bounded: bool = False
    roulette: bool = False
    records: bool = False
    layered: bool = False
    pattern: bool = False
    specular: bool = False
    lens: Lens = PINHOLE
    measured_beam: bool = False
    confocal: bool = False
    rotated_domain: bool = False


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
class _Walk:
    """State of a thread between the stages.

    A struct and not local variables: Warp merges a local that is set under a condition with a select, which keeps the
    values of both branches alive around the loop and doubles the registers; attributes are assigned in place.
    """

    stage: int
    # The warp's stock of new photons:
    first: int  # of them
    taken: int
    # The photon:
    photon: int
    x: wp.vec3
    u: wp.vec3
    weight: float
    analog_weight: float
    ledger_weight: wp.int64
    path: float
    collisions: int
    surface_count: int
    reason: int  # ledger entry of the history's end
    target: int  # pixel that a scan scores it in, else -1, and what it may be seen in
    view: wp.vec4
    # Its next event:
    block: wp.vec4ui
    sample_block: wp.vec4ui
    distance: float  # to the end of the flight
    face: int  # hit there; -1 in the water
    slot: int  # of that face
    normal: wp.vec3
    albedo: float
    # The ray to trace, and the contribution that waits for it:
    ray: int
    reach: float
    node: int  # of its walk down the tree; FINISHED if it has none
    depth: int
    nearest: float
    found: int  # slot of the nearest face
    interval: wp.vec2  # of the flight that the camera sees
    origin: wp.vec3  # the point that is scored
    lens: wp.vec3
    dither: float
    pending_index: int
    pending_value: float
    late: wp.vec2l  # a voxel that is still to be added to
    # What the thread has to tell:
    absorbed_water: wp.int64
    absorbed_surface: wp.int64
    directed: wp.int64
    water_collisions: int
    surface_events: int
    surface_queries: int
    shadow_queries: int
    contributions: int


@functools.cache
def make_transport_kernel(spec: TransportSpec, cuda: bool = False) -> wp.Kernel:
    """The transport kernel for a spec; launch grid: any number of threads, which share the photons among them.

    On CUDA they must be a multiple of the block size, since whole warps vote.
    """
    if spec.estimator not in ESTIMATORS:
        raise ValueError(f"estimator = {spec.estimator!r} is not one of {', '.join(ESTIMATORS)}")
    analog = spec.estimator == "analog"
    next_event = spec.estimator == "next_event"
    guided = spec.estimator == "guided"
    random_albedo, has_mesh, brute_force, bounded, roulette, records = spec[2:8]
    layered, pattern, specular = spec.layered, spec.pattern, spec.specular
    local_albedo = layered and not random_albedo
    water_free_path, _, water_at = LAYERED if layered else HOMOGENEOUS
    confocal = spec.confocal
    pinhole = spec.lens.name == PINHOLE.name
    if confocal and pinhole:
        raise ValueError("confocal = True needs lens = CALIBRATED")
    project, clip_to_view, may_be_hidden, in_view, toward_axis = spec.lens[1:]
    emit = emit_measured if spec.measured_beam else emit_along
    to_exit, face_of_exit, outside = (
        (exit_distance_rotated, exit_face_rotated, is_outside_rotated)
        if spec.rotated_domain
        else (exit_distance, exit_face, is_outside)
    )
    # A handful of faces is tried on the spot; rays for a tree wait until the warp has enough of them. A core walks the
    # tree of a box in a third of the time that its twelve faces take.
    brute_force = brute_force and cuda
    has_bvh = has_mesh and not brute_force
    phase_pdf, phase_sample = spec.phase.pdf, spec.phase.sample
    reflectance_at = pattern_reflectance if pattern else face_reflectance
    guide = spec.phase.guide or HENYEY_GREENSTEIN_GUIDE
    has_phase_guide = spec.phase.guide is not None
    lobe_pdf, lobe_sample = guide.lobe_pdf, guide.lobe_sample
    ray_lanes = RAY_LANES if has_bvh else 32
    scores = next_event or guided
    gathers = scores and cuda and not has_bvh
    score = make_score(spec) if scores else None
    shelve, fetch = make_gathering(spec.estimator)

    @wp.kernel(
        module="unique",
        module_options={"fast_math": cuda},
        enable_backward=False,
        cuda_max_registers=MAX_REGISTERS[spec.estimator][has_bvh],
    )
    def transport(
        # Model:
        medium: Medium,
        layers: Layers,
        laser: Laser,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        guiding: Guiding,
        surfaces: Surfaces,
        scan: Scan,
        # Photons:
        seed: wp.uint64,
        keys: RoundKeys,
        first_id: wp.uint64,
        photon_count: int,
        # Data out:
        scale: float,
        tally: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        out: Records,
        cursor: wp.array(dtype=int),
    ):
        thread = wp.tid()
        s = _Walk()
        s.stage = _START
        s.albedo = medium.albedo
        s.view = camera.view
        s.target = -1
        s.node = FINISHED
        if wp.static(has_bvh and cuda):
            stack = Stack()
            stack[0] = FINISHED
        # On the CPU one thread walks all photons.
        lane = thread % wp.static(32 if cuda else 1)
        s.first = -1
        s.taken = 32
        if wp.static(not cuda):
            # Launches on several cores write to slots of the ledger that lie in cache lines of their own.
            thread = 8 * int((first_id >> wp.uint64(10)) & wp.uint64(511))
        done = int(0)
        gathered = int(0)
        if wp.static(gathers):
            gathered = places(SET_PLACES, 0)

        while count_lanes(s.stage == _DONE) < 32:
            # ---- Water: until enough lanes of the warp wait for a ray
            waiting = int(0)
            while waiting < wp.static(ray_lanes):
                if s.stage == _FLIGHT:
                    id = first_id + wp.uint64(s.photon)
                    s.block = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_TRANSPORT)
                    s.face = -1
                    s.distance = water_free_path(medium, layers, s.x, s.u, u01(s.block[0]))
                    limit = limits.max_path - s.path
                    s.reach = wp.min(s.distance, limit)
                    if wp.static(random_albedo):
                        draw = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_ROULETTE)
                        s.albedo = medium.albedo * u01(draw[1])
                    s.stage = _EVENT
                    if wp.static(guided):
                        s.sample_block = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_FLIGHT_SAMPLE)
                        s.lens = lens_point(camera, u01(s.sample_block[2]), u01(s.sample_block[3]))
                        if wp.static(bounded):
                            limit = wp.min(limit, to_exit(limits, s.x, s.u))
                        s.interval = clip_to_view(camera, s.view, s.x, s.u, s.lens, limit)
                        s.interval = clip_to_gate(gate, s.x, s.u, s.path, s.lens, s.interval)
                        if not (wp.static(layered) or medium.extinction > 0.0):
                            s.interval = wp.vec2(0.0, 0.0)
                        if s.interval[0] < s.interval[1]:
                            s.reach = wp.max(s.reach, s.interval[1])
                    if wp.static(has_mesh):
                        if wp.static(has_bvh):
                            if segment_meets_box(s.x, s.u, s.reach, surfaces.lower, surfaces.upper):
                                s.ray = _SURFACE_RAY
                        else:
                            hit = intersect_faces(surfaces, s.x, s.u, s.reach)
                            s.surface_queries += 1
                            if hit.face >= 0:
                                s.interval = wp.vec2(s.interval[0], wp.min(s.interval[1], hit.distance))
                                if hit.distance < s.distance:
                                    s.distance = hit.distance
                                    s.face = hit.face
                                    s.slot = hit.slot
                                    s.normal = hit.normal

                # Guided scores the flight first, both score where it ends.
                round = int(wp.static(0 if guided else 1))
                while round < 2:
                    wanted = False
                    q = Request()
                    if wp.static(guided):
                        if round == 0 and s.stage == _EVENT and s.ray == _NO_RAY and s.interval[0] < s.interval[1]:
                            wanted = True
                            q.x = s.x
                            q.u = s.u
                            q.weight = wp.where(wp.static(local_albedo), s.weight, s.weight * s.albedo)
                            q.path = s.path
                            q.lens = s.lens
                            q.interval = s.interval
                            q.first = s.sample_block[0]
                            q.second = s.sample_block[1]
                            q.dither = s.sample_block[2]
                            q.component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                            q.slot = -1
                            q.target = s.target
                            s.interval = wp.vec2(0.0, 0.0)
                            if wp.static(gathers):
                                shelve(places(TAKE_PLACE, 0), q)
                    # What guided has sampled may wait for its shadow ray: without a surface nothing more is scored.
                    if (
                        round == 1
                        and s.stage == _EVENT
                        and (s.ray == _NO_RAY or (wp.static(guided) and s.ray == _SHADOW_RAY and s.face < 0))
                    ):
                        s.reason = -1
                        limit = limits.max_path - s.path
                        if wp.static(analog):
                            # Does the flight pass through the aperture, before anything else happens to it?
                            if s.u[2] < 0.0 and s.collisions > 0:
                                crossing = -s.x[2] / s.u[2]
                                on_lens = s.x + crossing * s.u
                                pixel = project(camera, s.view, s.target, s.x, on_lens)
                                radius2 = on_lens[0] * on_lens[0] + on_lens[1] * on_lens[1]
                                inside = radius2 <= camera.aperture_radius * camera.aperture_radius
                                if pixel >= 0 and inside and crossing <= wp.min(s.distance, limit):
                                    component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                                    if s.surface_count == 1 and s.collisions == 1:
                                        component = BALLISTIC
                                    s.contributions += 1
                                    s.late = deposit(
                                        tally,
                                        ledger,
                                        s.late,
                                        thread,
                                        tally_index(camera, gate, pixel, s.path + crossing, component),
                                        s.weight,
                                        scale,
                                        u01_last(s.block[0]),
                                    )
                        if s.distance > limit:
                            s.reason = MAX_PATH
                            s.distance = limit
                        if wp.static(bounded):
                            if outside(limits, s.x + s.distance * s.u):
                                s.reason = face_of_exit(limits, s.x, s.u)
                                s.distance = wp.min(s.distance, to_exit(limits, s.x, s.u))
                        s.x = s.x + s.distance * s.u
                        s.path += s.distance
                        s.stage = _END
                        if s.reason < 0:
                            s.stage = _SCATTER
                            s.collisions += 1
                            if wp.static(local_albedo):
                                s.albedo = water_at(medium, layers, s.x).albedo
                            if wp.static(has_mesh):
                                if s.face >= 0:
                                    s.x = offset_from_surface(s.x, s.normal, s.distance)
                            if wp.static(scores):
                                # Water collisions are scored here by next_event alone: guided has scored the flight.
                                if wp.static(next_event) or s.face >= 0:
                                    pixel = int(0)
                                    if wp.static(pinhole):
                                        # Whatever the lens point; the others need it.
                                        pixel = project(camera, s.view, s.target, s.x, s.x)
                                    if pixel >= 0:
                                        wanted = True
                                        q.x = s.x
                                        q.u = s.u
                                        q.weight = s.weight
                                        q.path = s.path
                                        # guided keeps the flight's point of the lens; else the word that it alone
                                        # needs.
                                        if wp.static(guided):
                                            q.lens = s.lens
                                        q.interval = wp.vec2(0.0, 0.0)
                                        q.first = s.block[3]
                                        q.dither = s.block[0]  # bits that the flight left
                                        q.slot = -1
                                        q.target = s.target
                                        q.component = FORWARD_SCATTERED
                                        if s.face >= 0:
                                            q.slot = s.slot
                                            if s.collisions == 1:
                                                q.component = BALLISTIC
                                        else:
                                            q.weight *= s.albedo
                                            if s.surface_count == 0:
                                                q.component = BACKSCATTER
                                        if wp.static(gathers):
                                            shelve(places(TAKE_PLACE, 0), q)
                    round += 1

                    # ---- Scores: each lane its own or, where a warp gathers them, 32 together
                    if wp.static(scores):
                        first = int(0)
                        ready = wanted
                        if wp.static(gathers):
                            gathered = places(COUNT_PLACES, 0)
                            first = wp.max(gathered - 32, 0)
                            ready = gathered >= 32 or (done == 32 and gathered > 0)
                        if ready:
                            request = q
                            wanted = True
                            if wp.static(gathers):
                                wanted = first + lane < gathered
                                request = fetch(wp.min(first + lane, gathered - 1))
                                gathered = places(SET_PLACES, first)
                            found = score(request, medium, layers, camera, gate, surfaces, scan)
                            if wanted and not found.value <= 0.0:  # what is not a number is counted as such
                                s.contributions += 1
                                seen = True
                                if wp.static(has_mesh):
                                    if may_be_hidden(camera, surfaces.near_depth, found.origin):
                                        seen = not segment_meets_box(
                                            found.origin,
                                            found.lens - found.origin,
                                            1.0,
                                            surfaces.lower,
                                            surfaces.upper,
                                        )
                                        if wp.static(brute_force):
                                            if not seen:
                                                s.shadow_queries += 1
                                                to = found.lens - found.origin
                                                length = wp.length(to)
                                                hit = intersect_faces(surfaces, found.origin, to / length, length)
                                                found.value = wp.where(hit.face < 0, found.value, 0.0)
                                                seen = True
                                if seen:
                                    if not found.value <= 0.0:
                                        s.late = deposit(
                                            tally, ledger, s.late, thread, found.index, found.value, scale, found.dither
                                        )
                                else:
                                    s.ray = _SHADOW_RAY
                                    s.origin = found.origin
                                    s.lens = found.lens
                                    s.pending_index = found.index
                                    s.pending_value = found.value
                                    s.dither = found.dither

                if s.stage == _SCATTER and s.ray == _NO_RAY:
                    # The score took the photon as it arrived; now its weight, its end or its new direction.
                    survival = float(s.albedo)
                    if wp.static(specular):
                        lobe = float(0.0)
                        incoming = wp.vec3(s.u)
                    if wp.static(has_mesh):
                        if s.face >= 0:
                            survival = reflectance_at(surfaces, s.face, s.x)
                            if wp.static(specular):
                                survival += surfaces.specular[s.face]
                                lobe = surfaces.specular[s.face] / wp.max(survival, 1.0e-30)
                            # The ledger is written up where weight changes hands; water takes what is missing there.
                            before = to_ledger(s.weight)
                            s.absorbed_water += s.ledger_weight - before
                            s.ledger_weight = to_ledger(s.weight * survival)
                            s.absorbed_surface += before - s.ledger_weight
                            s.surface_count += 1
                    s.weight *= survival
                    if wp.static(guided):
                        s.analog_weight *= survival
                    else:
                        s.analog_weight = s.weight

                    s.reason = -1
                    if s.analog_weight < limits.weight_cutoff or s.analog_weight <= 0.0:
                        s.reason = WEIGHT_CUTOFF
                        if wp.static(roulette):
                            id = first_id + wp.uint64(s.photon)
                            chance = u01(random_block_keyed(keys, id, wp.uint32(s.collisions), STREAM_ROULETTE)[0])
                            s.reason = ROULETTE
                            if chance < 0.1 and s.analog_weight > 0.0:
                                s.reason = -1
                                before = to_ledger(s.weight)
                                s.absorbed_water += s.ledger_weight - before
                                s.weight *= 10.0
                                s.analog_weight *= 10.0
                                s.ledger_weight = to_ledger(s.weight)
                                add_to_ledger(ledger, thread, ROULETTE, before - s.ledger_weight)
                    if s.reason < 0 and s.collisions >= limits.max_collisions:
                        s.reason = MAX_COLLISIONS

                    s.stage = _END
                    if s.reason < 0:
                        s.stage = _FLIGHT
                        on_surface = False
                        if wp.static(has_mesh):
                            on_surface = s.face >= 0
                        snapped = snap_direction(s.u, medium.axis_threshold)
                        if wp.static(specular):
                            reflected = wp.vec3(s.u)
                            if on_surface:
                                id = first_id + wp.uint64(s.photon)
                                draw = random_block_keyed(keys, id, wp.uint32(s.collisions), STREAM_SURFACE)
                                reflected = sample_reflection(
                                    incoming, s.normal, surfaces.roughness[s.face], lobe, draw
                                )
                        if wp.static(guided):
                            # Towards the lens, or back into the view, with some chance; the weight makes up for it.
                            v = -wp.normalize(s.x)
                            if wp.static(has_phase_guide):
                                # To the point of the lens at which the flight to come will be scored: a lobe about
                                # the lens's centre could not have a peak narrower than the lens.
                                id = first_id + wp.uint64(s.photon)
                                ahead = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_FLIGHT_SAMPLE)
                                v = wp.normalize(lens_point(camera, u01(ahead[2]), u01(ahead[3])) - s.x)
                            inward = toward_axis(s.view, s.x)
                            to_lens_chance = wp.where(on_surface, guiding.surface_probability, guiding.probability)
                            to_view_chance = float(0.0)
                            if wp.dot(inward, inward) > 0.0 and not in_view(camera, s.view, s.target, s.x):
                                to_view_chance = guiding.return_probability
                                inward = wp.normalize(inward)
                            choice = u01(s.block[3])
                            here = water_at(medium, layers, s.x)
                            axis = snapped
                            t = phase_sample(u01_fine(s.block[1]), here)
                            if on_surface:
                                axis = s.normal
                                t = sample_cosine_law(u01(s.block[1]))
                            if choice < to_lens_chance:
                                axis = v
                                t = lobe_sample(u01_fine(s.block[1]), medium, guiding)
                            elif choice < to_lens_chance + to_view_chance:
                                axis = inward
                                t = sample_henyey_greenstein(u01_fine(s.block[1]), guiding.return_anisotropy)
                            s.u = rotate_direction(axis, t, u01(s.block[2]))
                            if wp.static(specular):
                                if on_surface and choice >= to_lens_chance + to_view_chance:
                                    s.u = reflected
                            density = phase_pdf(one_minus_cosine(snapped, s.u), here)
                            if on_surface:
                                density = wp.max(wp.dot(s.u, s.normal), 0.0) * 0.3183098861837907
                                if wp.static(specular):
                                    density = reflection_pdf(incoming, s.u, s.normal, surfaces.roughness[s.face], lobe)
                            mixture = (1.0 - to_lens_chance - to_view_chance) * density
                            mixture += to_lens_chance * lobe_pdf(one_minus_cosine(v, s.u), medium, guiding)
                            if to_view_chance > 0.0:
                                mixture += to_view_chance * henyey_greenstein_pdf(
                                    one_minus_cosine(inward, s.u), guiding.return_anisotropy
                                )
                            before = to_ledger(s.weight)
                            s.absorbed_water += s.ledger_weight - before
                            s.weight *= density / wp.max(mixture, 1.0e-30)
                            s.ledger_weight = to_ledger(s.weight)
                            s.directed += before - s.ledger_weight
                            if s.weight <= 0.0:
                                s.reason = DIRECTED
                                s.stage = _END
                        else:
                            axis = snapped
                            t = phase_sample(u01_fine(s.block[1]), water_at(medium, layers, s.x))
                            if on_surface:
                                axis = s.normal
                                t = sample_cosine_law(u01(s.block[1]))
                            s.u = rotate_direction(axis, t, u01(s.block[2]))
                            if wp.static(specular):
                                if on_surface:
                                    s.u = reflected

                        if wp.static(specular):
                            if on_surface:
                                # What one facet takes of another's light stays in the surface.
                                leaving = unshadowed(incoming, s.u, s.normal, surfaces.roughness[s.face], lobe)
                                before = to_ledger(s.weight)
                                s.absorbed_water += s.ledger_weight - before
                                s.weight *= leaving
                                s.analog_weight *= leaving
                                s.ledger_weight = to_ledger(s.weight)
                                s.absorbed_surface += before - s.ledger_weight
                                if s.weight <= 0.0 and s.stage == _FLIGHT:
                                    s.reason = WEIGHT_CUTOFF
                                    s.stage = _END

                # ---- The next photon for those that have ended
                if count_lanes(s.stage >= _START) >= START_LANES:
                    if s.stage == _END and s.ray == _NO_RAY:
                        after = to_ledger(s.weight)
                        s.absorbed_water += s.ledger_weight - after
                        add_to_ledger(ledger, thread, s.reason, after)
                        s.water_collisions += s.collisions - s.surface_count
                        s.surface_events += s.surface_count
                        if wp.static(records):
                            out.position[s.photon] = s.x
                            out.direction[s.photon] = s.u
                            out.weight[s.photon] = s.weight
                            out.path[s.photon] = s.path
                            out.collisions[s.photon] = s.collisions
                            out.reason[s.photon] = s.reason
                        s.stage = _START
                    wanting = s.stage == _START
                    place = count_lanes_before(wanting)
                    if wp.static(cuda):
                        # All lanes emit a photon each, which those that have ended take one by one.
                        if s.taken >= 32:
                            s.first = take_photons(cursor)
                            s.taken = 0
                            id = first_id + wp.uint64(s.first + lane)
                            axis = laser.axis
                            if wp.static(confocal):
                                axis = scan.axis[int(id % wp.uint64(scan.count))]
                            start, heading = emit(laser, axis, seed, id)
                            exchange(True, lane, wp.spatial_vector(start, heading))
                        place += s.taken
                        s.taken += count_lanes(wanting)
                    elif wanting:
                        s.first += 1
                    if wanting and place < 32:
                        s.photon = s.first + place
                        s.stage = _DONE
                        if s.photon < photon_count:
                            id = first_id + wp.uint64(s.photon)
                            if wp.static(confocal):
                                s.target = int(id % wp.uint64(scan.count))
                                s.view = scan.view[s.target]
                            if wp.static(cuda):
                                fresh = exchange(False, place, wp.spatial_vector())
                                s.x = wp.spatial_top(fresh)
                                s.u = wp.spatial_bottom(fresh)
                            else:
                                axis = laser.axis
                                if wp.static(confocal):
                                    axis = scan.axis[s.target]
                                start, heading = emit(laser, axis, seed, id)
                                s.x = start
                                s.u = heading
                            s.weight = 1.0
                            s.analog_weight = 1.0
                            s.ledger_weight = to_ledger(1.0)
                            s.path = 0.0
                            s.collisions = 0
                            s.surface_count = 0
                            s.stage = _FLIGHT

                if wp.static(has_bvh):
                    waiting = count_lanes(s.ray != _NO_RAY or s.stage >= _START)
                else:
                    done = count_lanes(s.stage == _DONE)
                    waiting = wp.where(gathered > 0, 0, done)

            # ---- Surfaces: the warp traces its rays together
            if wp.static(has_bvh):
                origin = s.x
                to = s.u
                if wp.static(scores):
                    if s.ray == _SHADOW_RAY:
                        origin = s.origin
                        to = wp.normalize(s.lens - origin)
                if s.ray != _NO_RAY and s.node == FINISHED:
                    s.found = -1
                    s.nearest = s.reach
                    if wp.static(scores):
                        if s.ray == _SHADOW_RAY:
                            s.nearest = wp.length(s.lens - origin)
                    if wp.static(cuda):
                        s.node = 0
                        s.depth = 1  # below everything stands FINISHED
                    else:
                        hit = intersect_surfaces(surfaces, origin, to, s.nearest, s.ray == _SHADOW_RAY)
                        s.found = hit.slot
                        s.nearest = hit.distance
                if wp.static(cuda):
                    inverse = inverse_direction(to)
                    shift = wp.cw_mul(origin, inverse)
                    # Until so few walk on that new rays should join them; all take steps of one kind.
                    in_nodes = count_lanes(s.node > FINISHED)
                    at_faces = count_lanes(s.node < FINISHED)
                    company = int(1)
                    while in_nodes + at_faces >= company:
                        company = wp.static(WALKING_LANES)
                        if in_nodes >= at_faces:
                            if s.node > FINISHED:
                                near, far = walk_node(surfaces.nodes, s.node, inverse, shift, s.nearest)
                                s.node = near
                                if far != FINISHED:
                                    stack[s.depth] = far
                                    s.depth += 1
                                if near == FINISHED:
                                    s.depth -= 1
                                    s.node = stack[s.depth]
                        elif s.node < FINISHED:
                            slot = -2 - s.node
                            distance = face_distance(surfaces.faces, slot, origin, to)
                            if surfaces.order[slot] >= 0:
                                s.depth -= 1
                                s.node = stack[s.depth]
                            else:
                                s.node -= 1  # the next face of the leaf
                            if distance >= 0.0 and distance < s.nearest:
                                s.nearest = distance
                                s.found = slot
                                if s.ray == _SHADOW_RAY:
                                    s.node = FINISHED
                        in_nodes = count_lanes(s.node > FINISHED)
                        at_faces = count_lanes(s.node < FINISHED)
                if s.ray != _NO_RAY and s.node == FINISHED:
                    if s.ray == _SURFACE_RAY:
                        s.surface_queries += 1
                        if s.found >= 0:
                            s.interval = wp.vec2(s.interval[0], wp.min(s.interval[1], s.nearest))
                            if s.nearest < s.distance:
                                s.distance = s.nearest
                                s.slot = s.found
                                s.face = face_in(surfaces.order, s.slot)
                                s.normal = face_normal(surfaces.faces, s.slot, s.u)
                    else:
                        s.shadow_queries += 1
                        if s.found < 0:
                            s.late = deposit(
                                tally, ledger, s.late, thread, s.pending_index, s.pending_value, scale, s.dither
                            )
                    s.ray = _NO_RAY

        if wp.static(not cuda and spec.estimator != "none"):
            atomic_add_int64(tally, int(s.late[0]), s.late[1])
        add_to_ledger(ledger, thread, ABSORBED_WATER, s.absorbed_water)
        add_to_ledger(ledger, thread, ABSORBED_SURFACE, s.absorbed_surface)
        add_to_ledger(ledger, thread, DIRECTED, s.directed)
        add_to_ledger(ledger, thread, WATER_COLLISIONS, wp.int64(s.water_collisions))
        add_to_ledger(ledger, thread, SURFACE_EVENTS, wp.int64(s.surface_events))
        add_to_ledger(ledger, thread, SURFACE_QUERIES, wp.int64(s.surface_queries))
        add_to_ledger(ledger, thread, SHADOW_QUERIES, wp.int64(s.shadow_queries))
        add_to_ledger(ledger, thread, CONTRIBUTIONS, wp.int64(s.contributions))

    return transport
