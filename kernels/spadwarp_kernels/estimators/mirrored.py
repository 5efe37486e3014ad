"""Next events by way of the faces of the domain: the light of an event that reaches the lens after reflections."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import join_words, u01, u01_high, u01_low
from spadwarp_kernels.optics.camera import Camera, Gate, lens_point
from spadwarp_kernels.optics.laser import Scan
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.riders.derivatives import make_flight_scores, make_turn_scores
from spadwarp_kernels.riders.polarisation import (
    Polarisation,
    make_add_channels,
    make_event_stokes,
    make_leave_water,
    make_receive,
    make_reflected_stokes,
)
from spadwarp_kernels.surface.bvh import segment_meets_box
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, meets_faces
from spadwarp_kernels.tally.scores import Derivatives, make_deposit
from spadwarp_kernels.tally.tally import BALLISTIC, FORWARD_SCATTERED, Scores, tally_index
from spadwarp_kernels.water.limits import (
    Limits,
    face_index,
    flipped,
    image_direction,
    image_point,
    image_reflectance,
    next_face,
    reflections_of,
    to_next_face,
)
from spadwarp_kernels.water.medium import Layers, Medium

from .contribution import Request, Scored, make_scattering
from .link import make_link


@wp.struct
class Way:
    """What is on the way of an image: the optical depth, whether nothing is in between, rays traced for that, and the
    scores at its end."""

    depth: float
    clear: bool
    shadow_queries: int
    scores: Scores


@wp.func
def _to_domain(limits: Limits, v: wp.vec3) -> wp.vec3:
    return limits.rotation * v


@wp.func
def _from_domain(limits: Limits, v: wp.vec3) -> wp.vec3:
    return wp.transpose(limits.rotation) * v


@wp.func
def _same(limits: Limits, v: wp.vec3) -> wp.vec3:
    return v


@wp.func
def _origin(limits: Limits) -> wp.vec3:
    return limits.origin


@wp.func
def _no_origin(limits: Limits) -> wp.vec3:
    return wp.vec3(0.0)


@memoised
def make_way(spec: TransportSpec, brute_force: bool) -> wp.Function:
    """The Warp function ``(x, v, length, reflections, scores, medium, layers, limits, surfaces, derivatives, seed) ->
    Way`` of the light that leaves x along v, in the domain's axes, and is reflected so many times within that
    length."""
    has_mesh, derives = spec.mesh, bool(spec.derivatives)
    flight_scores = make_flight_scores(spec)
    water_extinction = spec.water.extinction
    turn_back, origin = (_from_domain, _origin) if spec.rotated_domain else (_same, _no_origin)

    @wp.func
    def way_of(
        x: wp.vec3,
        v: wp.vec3,
        length: float,
        reflections: int,
        scores: Scores,
        medium: Medium,
        layers: Layers,
        limits: Limits,
        surfaces: Surfaces,
        derivatives: Derivatives,
        seed: wp.uint64,
    ) -> Way:
        way = Way()
        way.scores = scores
        way.clear = True
        begin = wp.vec3(x)
        along = wp.vec3(v)
        rest = float(length)
        for k in range(reflections + 1):
            part = float(rest)
            face = int(0)
            if k < reflections:
                part = wp.min(rest, to_next_face(limits, begin, along))
                face = next_face(limits, begin, along)
            start = turn_back(limits, begin - origin(limits))
            heading = turn_back(limits, along)
            way.depth += part * water_extinction(medium, layers, start, heading, part, seed + wp.uint64(k))
            if wp.static(derives):
                way.scores = flight_scores(way.scores, derivatives, layers, start, heading, part)
            if wp.static(has_mesh):
                if way.clear and segment_meets_box(start, heading, part, surfaces.lower, surfaces.upper):
                    way.shadow_queries += 1
                    if wp.static(brute_force):
                        way.clear = not meets_faces(surfaces, start, heading, part)
                    else:
                        way.clear = intersect_surfaces(surfaces, start, heading, part, True).face < 0
            begin += part * along
            rest -= part
            if face > 0:
                along = flipped(along, (face - 1) // 2)
        return way

    return way_of


@memoised
def make_leaving_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, v, derivatives, medium, layers, surfaces) -> Scores`` of light that the event of a
    request sends along v."""
    turn_scores = make_turn_scores(spec)

    @wp.func
    def leaving_scores(
        q: Request, v: wp.vec3, derivatives: Derivatives, medium: Medium, layers: Layers, surfaces: Surfaces
    ) -> Scores:
        return turn_scores(q.scores, q.x, q.u, v, q.slot, derivatives, medium, layers, surfaces)

    return leaving_scores


@memoised
def make_image_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, x, v, length, reflections, end, inside, camera, limits, surfaces, polarisation) ->
    vec4`` of light that the event of a request sends along v, in the domain's axes from x on, and that is reflected so
    many times on its way to the end of the water, where it leaves for the lens along `inside`."""
    event_stokes, reflected_stokes = make_event_stokes(spec), make_reflected_stokes()
    leave_water, receive = make_leave_water(spec), make_receive(spec)
    turn_back = _from_domain if spec.rotated_domain else _same

    @wp.func
    def image_stokes(
        request: Request,
        x: wp.vec3,
        v: wp.vec3,
        length: float,
        reflections: int,
        end: wp.vec3,
        inside: wp.vec3,
        camera: Camera,
        limits: Limits,
        surfaces: Surfaces,
        polarisation: Polarisation,
    ) -> wp.vec4:
        heading = turn_back(limits, v)
        stokes = event_stokes(request.stokes, polarisation, surfaces, request.slot, request.x, request.u, heading)
        begin = wp.vec3(x)
        along = wp.vec3(v)
        rest = float(length)
        for _k in range(reflections):
            part = wp.min(rest, to_next_face(limits, begin, along))
            face = next_face(limits, begin, along)
            begin += part * along
            rest -= part
            if face > 0:
                along = flipped(along, (face - 1) // 2)
                mirrored = turn_back(limits, along)
                stokes = reflected_stokes(stokes, heading, mirrored, face_index(limits.boundary, face))
                heading = mirrored
        along = wp.normalize(inside)
        return receive(leave_water(camera, stokes, end, heading, along), along)

    return image_stokes


@memoised
def make_score_image(spec: TransportSpec, flights: bool, brute_force: bool) -> wp.Function:
    """The Warp function ``(request, number, medium, layers, camera, gate, limits, surfaces, scan, derivatives,
    polarisation) -> Scored`` of an event by way of one of `Boundary.images`; what stands in between has been looked
    for.

    `flights`: whether requests may ask for a point of a flight, which is not scored by way of reflections: events are.
    """
    confocal, needs_way, derives = spec.confocal, spec.mesh or spec.varies, bool(spec.derivatives)
    image_of = spec.lens.image or spec.lens.project
    scattering_density, way_of = make_scattering(spec), make_way(spec, brute_force)
    link_to, value_of = make_link(spec)
    flight_scores, leaving_scores = make_flight_scores(spec), make_leaving_scores(spec)
    polarised, image_stokes, add_channels = spec.polarised, make_image_stokes(spec), make_add_channels(spec)
    turn, turn_back, origin = (_to_domain, _from_domain, _origin) if spec.rotated_domain else (_same, _same, _no_origin)

    @wp.func
    def score_image(
        request: Request,
        number: int,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        surfaces: Surfaces,
        scan: Scan,
        derivatives: Derivatives,
        polarisation: Polarisation,
    ) -> Scored:
        found = Scored()
        if wp.static(flights):
            if request.interval[0] < request.interval[1]:
                return found
        image = limits.boundary.images[number]
        x = turn(limits, request.x) + origin(limits)
        seen = turn_back(limits, image_point(limits.lower, limits.upper, image, x) - origin(limits))
        lens = lens_point(camera, u01_high(request.first), u01_low(request.first))
        view = camera.view
        if wp.static(confocal):
            view = scan.view[request.target]
        # The lens, or a port, sees the image as it would see a point in water without an end.
        link = link_to(camera, seen, lens)
        pixel = image_of(camera, view, request.target, link.image, lens)
        if pixel < 0:
            return found
        along = turn(limits, link.to_lens)
        heading = image_direction(image, along)
        v = turn_back(limits, heading)
        scattering = scattering_density(request, request.x, v, v, 1.0, medium, layers, surfaces)
        scattering *= image_reflectance(limits.boundary, image, along)
        extinction = float(medium.extinction)
        if wp.static(derives):
            found.contribution.scores = leaving_scores(request, v, derivatives, medium, layers, surfaces)
            if wp.static(not needs_way):
                found.contribution.scores = flight_scores(
                    found.contribution.scores, derivatives, layers, request.x, request.u, link.water
                )
        if wp.static(needs_way):
            if not scattering <= 0.0:
                seed = join_words(request.first, wp.uint32(number + 1) << wp.uint32(8))
                way = way_of(
                    x,
                    heading,
                    link.water,
                    reflections_of(image),
                    found.contribution.scores,
                    medium,
                    layers,
                    limits,
                    surfaces,
                    derivatives,
                    seed,
                )
                found.contribution.scores = way.scores
                found.shadow_queries = way.shadow_queries
                extinction = way.depth / link.water
                scattering = wp.where(way.clear, scattering, 0.0)
        if not scattering <= 0.0:
            component = wp.where(request.component == BALLISTIC, FORWARD_SCATTERED, request.component)
            found.contribution.rounding_sample = u01(request.rounding_sample)
            found.contribution.value = value_of(camera, extinction, request.weight, scattering, link)
            found.contribution.index = tally_index(camera, gate, pixel, request.path + link.path, component)
            if wp.static(polarised):
                stokes = image_stokes(
                    request, x, heading, link.water, reflections_of(image), link.end, lens - link.image, camera,
                    limits, surfaces, polarisation
                )  # fmt: skip
                found.contribution = add_channels(found.contribution, polarisation, stokes)
        return found

    return score_image


@wp.struct
class AddedScores:
    """What the images of an event, or the further points of a flight, have added: see `add_pending`, and counters of
    `PhotonState`."""

    pending_add: wp.vec2l
    contributions: int
    shadow_queries: int


@memoised
def make_score_images(spec: TransportSpec, flights: bool, brute_force: bool, split_accumulators: bool) -> wp.Function:
    """The Warp function ``(request, medium, layers, camera, gate, limits, surfaces, scan, derivatives,
    polarisation, tally, low, gradients, ledger, pending_add, thread, scale) -> AddedScores`` that scores an event by
    way of all images; arguments as of `make_score_image`."""
    score_image = make_score_image(spec, flights, brute_force)
    deposit = make_deposit(spec.signed, 0, split_accumulators)

    @wp.func
    def score_images(
        request: Request,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        surfaces: Surfaces,
        scan: Scan,
        derivatives: Derivatives,
        polarisation: Polarisation,
        tally: wp.array(dtype=wp.int64),
        low: wp.array(dtype=wp.uint32),
        gradients: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        pending_add: wp.vec2l,
        thread: int,
        scale: float,
    ) -> AddedScores:
        scores = AddedScores()
        scores.pending_add = pending_add
        if request.wanted:
            for number in range(limits.boundary.images.shape[0]):
                found = score_image(
                    request, number, medium, layers, camera, gate, limits, surfaces, scan, derivatives, polarisation
                )
                scores.shadow_queries += found.shadow_queries
                if not found.contribution.value <= 0.0:  # NaN is counted as such
                    scores.contributions += 1
                    scores.pending_add = deposit(
                        tally,
                        low,
                        gradients,
                        ledger,
                        scores.pending_add,
                        thread,
                        scale,
                        derivatives,
                        found.contribution,
                    )
        return scores

    return score_images
