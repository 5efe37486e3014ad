"""What a photon adds to a pixel by a next event: from where it scatters, or from a sampled point of its flight."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import from_bits
from spadwarp_kernels.base.philox import join_words, u01, u01_fine, u01_high, u01_low
from spadwarp_kernels.base.rotations import one_minus_cosine, set_apart, snap_from
from spadwarp_kernels.optics.camera import Camera, Gate, lens_point
from spadwarp_kernels.optics.laser import Scan
from spadwarp_kernels.optics.visibility import port_view
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import patch_face, tree_face
from spadwarp_kernels.surface.reflectance import face_reflectance, ggx_brdf, lambert_brdf, pattern_reflectance
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED, Contribution, Scores, tally_index
from spadwarp_kernels.water.medium import Layers, Medium
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN_GUIDE

from .flight_sampling import make_sample_flight
from .link import make_apparent_lens, make_link


@wp.struct
class Request:
    """What is to be scored; plain enough for another thread to do it.

    Attributes:
        wanted: Whether there is anything.
        x: Where the photon scatters, or where the flight begins [m].
        u: Its direction until there, or of the flight.
        weight: Of the photon; in water times the albedo, but for flights through water that varies, whose albedo is
            that of the sampled point.
        path: Geometric path up to x [m].
        lens: The point of the lens by which a flight is scored; others draw one from `first`.
        interval: The part of the flight to take a point from [m]; empty for a scattering.
        first, second: Random words: of the lens's point or, of a flight, of the choice and the distance; both of the
            tracking through a grid. With `takes_collisions` the second has the bits of the distance to the collision
            [m] where that is scored.
        rounding_sample: A random word, 24 bits of which are for the tally; what is scored must not depend on it.
        component: Index into COMPONENTS.
        slot: Of the face that scatters, see `SurfaceHit`; -1 for water.
        target: The pixel of a scan, else -1.
        scores: Of the photon up to x.
        stokes: Of the photon on its way along u, see `PhotonState`.
    """

    wanted: bool
    x: wp.vec3
    u: wp.vec3
    weight: float
    path: float
    lens: wp.vec3
    interval: wp.vec2
    first: wp.uint32
    second: wp.uint32
    rounding_sample: wp.uint32
    component: int
    slot: int
    target: int
    scores: Scores
    stokes: wp.vec4


@wp.struct
class Asked:
    """Holds the request of a thread: an attribute is assigned in place, see `PhotonState`."""

    request: Request


@wp.struct
class Scored:
    """What a request comes to.

    Attributes:
        contribution: To the tally, if nothing stands between the scored point and the lens.
        origin, lens: The scored point, and where its light leaves the water: the point of the lens, or of a port [m].
        to_lens: Unit direction of its light there.
        inside: Direction in which it arrives, of any length.
        seen: Whether nothing does; else a shadow ray must be traced.
        shadow_queries: Shadow rays that were traced.
    """

    contribution: Contribution
    origin: wp.vec3
    lens: wp.vec3
    to_lens: wp.vec3
    inside: wp.vec3
    seen: bool
    shadow_queries: int


@wp.struct
class ScoredPoint:
    """The point of a request: where it is [m], the photon's weight there, and the path up to it [m]; with
    `takes_collisions` the length of the flight up to there that the weight does not account for yet [m]."""

    x: wp.vec3
    weight: float
    path: float
    ahead: float


@memoised
def make_event_request(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(s, camera) -> Request`` of the event that the photon has come to."""
    view_of = spec.lens.view
    shows = spec.lens.shows if spec.port is None else port_view(spec.port).shows
    reflecting, tracks, derives = spec.reflecting, spec.grid is not None, bool(spec.derivatives)
    polarised, has_mesh = spec.polarised, spec.mesh

    @wp.func
    def event_request(s: PhotonState, camera: Camera) -> Request:
        q = Request()
        on_surface = False
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        # Mirrored, any point may be seen.
        if wp.static(not flights or reflecting) or on_surface:
            if wp.static(reflecting) or shows(camera, view_of(camera, s.view), s.x):
                q.wanted = True
                if wp.static(reflecting):
                    q.wanted = s.bounces.face == 0
                q.x = s.x
                q.u = s.u
                q.weight = s.weight.value
                q.path = s.path
                q.interval = wp.vec2(0.0, 0.0)
                q.first = s.flight.block[3]
                if wp.static(tracks):
                    q.second = s.flight.block[0]
                q.rounding_sample = s.flight.block[2]  # of the azimuth to come
                q.slot = -1
                q.target = s.target
                q.component = FORWARD_SCATTERED
                if wp.static(derives):
                    q.scores = s.scores
                if wp.static(polarised):
                    q.stokes = s.stokes
                if on_surface:
                    q.slot = s.hit.slot
                    if s.collisions == 1:
                        q.component = BALLISTIC
                else:
                    q.weight *= s.albedo
                    if wp.static(not has_mesh) or s.surface_count == 0:
                        q.component = BACKSCATTER
        return q

    return event_request


@wp.func
def scores_collision(word: wp.uint32) -> bool:
    """Whether a flight is scored at its collision: by the first bit of the first word of its request."""
    return (word >> wp.uint32(31)) > wp.uint32(0)


def takes_collisions(spec: TransportSpec) -> bool:
    """Whether half the points of flights are where the photon collides, if it does so in their interval."""
    return spec.water.profile is not None and spec.water.profile.draw is None


@memoised
def make_flight_point(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, medium, layers, camera) -> ScoredPoint`` that draws the point of a flight to be
    scored."""
    local_albedo = spec.varies and not spec.random_albedo
    water, profile = spec.water, spec.water.profile
    water_extinction, water_at = water.extinction, water.at
    sample_flight = make_sample_flight(spec.phase.guide or HENYEY_GREENSTEIN_GUIDE, profile)
    has_profile, collides = profile is not None, takes_collisions(spec)
    depth_along = profile.depth if profile is not None else water_extinction  # any function: it is not called
    apparent_lens = make_apparent_lens(spec)

    @wp.func
    def flight_point(request: Request, medium: Medium, layers: Layers, camera: Camera) -> ScoredPoint:
        point = ScoredPoint()
        # Layers: a density with the mean extinction; what is scored weighs with the exact one.
        s0 = request.interval[0]
        width = request.interval[1] - s0
        middle = request.x + (0.5 * (s0 + request.interval[1])) * request.u
        begin = request.x + s0 * request.u
        seed = join_words(request.first, request.second)
        from_lens = request.x - apparent_lens(camera, middle, request.lens)
        xi_choice = u01(request.first)
        xi = u01_fine(request.second)
        if wp.static(collides):
            if scores_collision(request.first):
                xi = from_bits(int(request.second))
        if wp.static(has_profile):
            flight = sample_flight(from_lens, request.u, request.interval, 0.0, medium, xi_choice, xi, layers, begin)
        else:
            mean = water_extinction(medium, layers, begin, request.u, width, seed)
            flight = sample_flight(from_lens, request.u, request.interval, mean, medium, xi_choice, xi)
        point.x = request.x + flight.s * request.u
        point.path = request.path + flight.s
        there = water_at(medium, layers, point.x)
        weight = float(request.weight)
        if wp.static(local_albedo):
            weight *= there.albedo
        if wp.static(collides):
            # What is scored at collisions has lost light by chance already. Both kinds of points share a density, of
            # about 1/2 c exp(-depth) + 3/4 p(angle): any would do that does not depend on chance (balance heuristic).
            from_angle = 1.5 * flight.density  # half of p
            about = wp.exp(-depth_along(medium, layers, request.x, request.u, flight.s))
            flight.density = from_angle + 0.5 * there.extinction * about
            if scores_collision(request.first):
                weight *= there.extinction * about
            else:
                weight *= 0.75 * there.extinction
                point.ahead = flight.s
                flight.density = wp.where(from_angle > 0.0, flight.density, 0.0)
        elif wp.static(has_profile):
            before = float(0.0)
            if s0 > 0.0:
                before = depth_along(medium, layers, request.x, request.u, s0)
            weight *= there.extinction * wp.exp(-before - flight.depth)
        else:
            passed = water_extinction(medium, layers, request.x, request.u, flight.s, seed)
            weight *= there.extinction * wp.exp(-passed * flight.s)
        point.weight = wp.where(flight.density <= 0.0, 0.0, weight / flight.density)
        return point

    return flight_point


def _fused_axes(spec: TransportSpec, flights: bool) -> int:
    """For how many of x, y, z the compiler for CUDA divides by the distance and subtracts in one operation, without
    polarisation.

    Found in the machine code of Warp 1.19 and CUDA 13. Where it is another number, the intensity differs in the last
    bits from that of the run without polarisation, and a test on a GPU fails.
    """
    if spec.mesh or spec.varies:
        return 0 if flights else 2
    return 2 if flights else 3


@memoised
def make_scattering(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(request, x, v, way, distance, medium, layers, surfaces) -> float``: density [1/sr] of what
    the water or the face of the request scatters at x into the direction v = way/distance. In water, polarised light
    takes the latter, rounded as without polarisation.
    """
    has_mesh, specular = spec.mesh, spec.specular
    water_at = spec.water.at
    phase_pdf = spec.phase.pdf
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance
    face_at = patch_face if spec.brute_force and not spec.use_warp_bvh else tree_face
    divides, fused = spec.polarised and spec.port is None, _fused_axes(spec, flights)

    @wp.func
    def scattering_density(
        request: Request,
        x: wp.vec3,
        v: wp.vec3,
        way: wp.vec3,
        distance: float,
        medium: Medium,
        layers: Layers,
        surfaces: Surfaces,
    ) -> float:
        scattering = float(0.0)
        on_surface = False
        if wp.static(has_mesh):
            on_surface = request.slot >= 0
            if on_surface:
                face, normal = face_at(surfaces, request.slot, request.u)
                cos_out = wp.max(wp.dot(v, normal), 0.0)
                scattering = lambert_brdf(reflectance_at(surfaces, face, x)) * cos_out
                if wp.static(specular):
                    scattering += (
                        surfaces.specular[face] * ggx_brdf(request.u, v, normal, surfaces.roughness[face]) * cos_out
                    )
        if not on_surface:
            snapped = snap_from(request.u, medium.axis_threshold)
            if wp.static(divides):
                quotient, to = set_apart(way) / distance, set_apart(v)
                for axis in range(wp.static(fused)):
                    to[axis] = quotient[axis]
                scattering = phase_pdf(one_minus_cosine(snapped, to), water_at(medium, layers, x))
            else:
                scattering = phase_pdf(one_minus_cosine(snapped, v), water_at(medium, layers, x))
        return scattering

    return scattering_density


@memoised
def make_score(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(request, medium, layers, camera, gate, surfaces, scan) -> Scored`` of next events.

    `flights`: whether requests may ask for a point of a flight.
    """
    confocal, reflecting, merged, polarised = spec.confocal, spec.reflecting, spec.merged, spec.polarised
    water_extinction, collides = spec.water.extinction, flights and takes_collisions(spec)
    image_of = spec.lens.image or spec.lens.project
    flight_point, scattering_density = make_flight_point(spec), make_scattering(spec, flights)
    link_to, value_of = make_link(spec)
    in_water = spec.port is None

    @wp.func
    def score(
        request: Request,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        surfaces: Surfaces,
        scan: Scan,
    ) -> Scored:
        found = Scored()
        found.contribution.rounding_sample = u01(request.rounding_sample)
        found.origin = request.x
        weight = float(request.weight)
        path = float(request.path)
        ahead = float(0.0)
        found.lens = lens_point(camera, u01_high(request.first), u01_low(request.first))
        if wp.static(flights):
            if wp.static(reflecting):
                if request.interval[0] >= request.interval[1] and request.slot < 0:
                    return found  # an event in the water, for its reflections alone
            if request.interval[0] < request.interval[1]:
                found.lens = request.lens
                point = flight_point(request, medium, layers, camera)
                found.origin = point.x
                weight = point.weight
                path = point.path
                ahead = point.ahead
        view = camera.view
        if wp.static(confocal):
            view = scan.view[request.target]
        link = link_to(camera, found.origin, found.lens)
        pixel = image_of(camera, view, request.target, link.image, found.lens)
        scattering = scattering_density(
            request, found.origin, link.to_lens, found.lens - found.origin, link.water, medium, layers, surfaces
        )
        if pixel >= 0 and not scattering <= 0.0:
            seed = join_words(request.second, request.first)
            if wp.static(collides):
                # The flight up to the point and the way to the lens by one loop: the code is long.
                extinction = float(0.0)
                while ahead >= 0.0:
                    begin = wp.where(ahead > 0.0, request.x, found.origin)
                    u = wp.where(ahead > 0.0, request.u, link.to_lens)
                    length = wp.where(ahead > 0.0, ahead, link.water)
                    extinction = water_extinction(medium, layers, begin, u, length, seed)
                    weight *= wp.where(ahead > 0.0, wp.exp(-extinction * ahead), 1.0)
                    seed += wp.uint64(0x632BE59BD9B4E019)  # another sequence
                    ahead = wp.where(ahead > 0.0, 0.0, -1.0)
            else:
                extinction = water_extinction(medium, layers, found.origin, link.to_lens, link.water, seed)
            component = wp.where(wp.static(merged), BALLISTIC, request.component)
            found.contribution.value = value_of(camera, extinction, weight, scattering, link)
            found.contribution.index = tally_index(camera, gate, pixel, path + link.path, component)
        if wp.static(polarised):
            found.inside = set_apart(found.lens) - set_apart(link.image)
            found.to_lens = link.to_lens
            if wp.static(in_water):
                found.to_lens = wp.normalize(found.inside)
        found.lens = link.end
        return found

    return score
