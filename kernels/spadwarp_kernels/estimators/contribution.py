"""What a photon adds to a pixel by a next event: from where it scatters, or from a sampled point of its flight."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import from_bits
from spadwarp_kernels.base.philox import join_words, u01, u01_fine, u01_high, u01_low
from spadwarp_kernels.base.rotations import one_minus_cosine, snap_from
from spadwarp_kernels.optics.camera import Camera, lens_point
from spadwarp_kernels.photon.queue import Request
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Contribution, PhotonState, World, tally_index
from spadwarp_kernels.riders.rider import NOTHING
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.ray_cast import patch_face, tree_face
from spadwarp_kernels.surface.reflectance import ggx_brdf, lambert_brdf
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN_GUIDE

from .flight_sampling import make_sample_flight

__all__ = ["next_event_value"]


# ---- The way of light from a point that is scored to a point of the lens, in water alone or through a port.


@wp.struct
class Link:
    """A way to the lens.

    Attributes:
        to_lens: Unit direction at the point.
        image: A point that the lens sees in the same direction, in air alone [m].
        end: Where the way leaves the water [m].
        water: Its length in the water [m].
        path: Length in water that takes as long as all of it [m].
        gather: What the lens gets of an intensity in that direction, without extinction, per area of the lens [sr/m^2];
            through a port.
    """

    to_lens: wp.vec3
    image: wp.vec3
    end: wp.vec3
    water: float
    path: float
    gather: float


@wp.func
def next_event_value(
    camera: Camera, extinction: float, weight: float, scattering: float, to_lens: wp.vec3, distance: float
) -> float:
    """Fraction of the photon that reaches a point of the aperture: w f exp(-c r) A cos(psi)/r^2, f [1/sr], to_lens a
    unit vector."""
    cos_lens = wp.max(-to_lens[2], 0.0)
    return (
        # Times -1: Warp's unary minus is 0 - x, an addition.
        weight
        * scattering
        * wp.exp((-1.0 * extinction) * distance)
        * camera.aperture_area
        * cos_lens
        / (distance * distance)
    )


@wp.func
def _link_in_water(camera: Camera, x: wp.vec3, o: wp.vec3) -> Link:
    link = Link()
    to_lens = o - x
    r = wp.length(to_lens)
    link.to_lens = to_lens / r
    link.image = x
    link.end = o
    link.water = r
    link.path = r
    return link


@wp.func
def _value_in_water(camera: Camera, extinction: float, weight: float, scattering: float, link: Link) -> float:
    return next_event_value(camera, extinction, weight, scattering, link.to_lens, link.water)


@wp.func
def _value_behind_port(camera: Camera, extinction: float, weight: float, scattering: float, link: Link) -> float:
    return weight * scattering * wp.exp(-extinction * link.water) * camera.aperture_area * link.gather


@memoised
def make_link(spec: TransportSpec) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions: ``(camera, x, o) -> Link`` from x to the lens point o, and ``(camera, extinction, weight,
    scattering, link) -> float``, the fraction of the photon that arrives."""
    if spec.port is None:
        return _link_in_water, _value_in_water
    connect = spec.port.connect

    @wp.func
    def link_behind_port(camera: Camera, x: wp.vec3, o: wp.vec3) -> Link:
        way = connect(camera.port, x, o)
        link = Link()
        link.to_lens = way.to_port
        link.image = o - way.inside
        link.end = way.exit
        link.water = way.water
        link.path = way.path
        link.gather = way.transmission * way.density * wp.max(-way.inside[2], 0.0)
        return link

    return link_behind_port, _value_behind_port


@wp.func
def _lens_in_water(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
    return o


@memoised
def make_apparent_lens(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(camera, x, o) -> vec3``: from where the light of the lens point o seems to come at x."""
    if spec.port is None:
        return _lens_in_water
    connect, apparent = spec.port.connect, spec.port.apparent

    @wp.func
    def apparent_lens(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
        way = connect(camera.port, x, o)
        seen = wp.vec3(o)
        if way.density > 0.0:
            seen = apparent(camera.port, x, o, way)
        return seen

    return apparent_lens


@wp.func
def _toward_in_water(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
    return wp.normalize(o - x)


@wp.func
def _toward_centre_in_water(camera: Camera, x: wp.vec3) -> wp.vec3:
    return (-1.0 / wp.max(wp.length(x), 1.0e-30)) * x


@memoised
def make_toward(spec: TransportSpec) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions: ``(camera, x, o) -> vec3``, the unit direction at x in which light gets to the lens point o,
    and ``(camera, x) -> vec3`` about that to the lens's centre; the straight one where there is no way."""
    if spec.port is None:
        return _toward_in_water, _toward_centre_in_water
    connect, apparent_centre = spec.port.connect, spec.port.apparent_centre

    @wp.func
    def toward_port(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
        way = connect(camera.port, x, o)
        return wp.where(way.density > 0.0, way.to_port, wp.normalize(o - x))

    @wp.func
    def toward_centre_behind_port(camera: Camera, x: wp.vec3) -> wp.vec3:
        return wp.normalize(apparent_centre(camera.port) - x)

    return toward_port, toward_centre_behind_port


# ---- Requests, and what they come to.


@wp.struct
class Scored:
    """What a request comes to.

    Attributes:
        contribution: To the tally, if nothing stands between the scored point and the lens.
        origin, lens: The scored point, and where its light leaves the water: the point of the lens, or of a port [m].
    """

    contribution: Contribution
    origin: wp.vec3
    lens: wp.vec3


@wp.struct
class ScoredPoint:
    """The point of a request: where it is [m], the photon's weight there, and the path up to it [m]; with
    `scores_collisions` the length of the flight up to there that the weight does not account for yet [m]."""

    x: wp.vec3
    weight: float
    path: float
    ahead: float


@memoised
def make_event_request(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(s, world) -> Request`` of the event that the photon has come to."""
    view_of, shows = spec.lens.view, spec.in_view
    reflecting, tracks, has_mesh = spec.reflecting, spec.grid is not None, spec.mesh
    rides = make_rider(spec) is not NOTHING

    @wp.func
    def event_request(s: wp.ref[PhotonState], world: wp.ref[World]) -> Request:
        q = Request()
        on_surface = False
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        # Mirrored, any point may be seen.
        if wp.static(not flights or reflecting) or on_surface:
            if wp.static(reflecting) or shows(world.camera, view_of(world.camera, s.view), s.x):
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
                if wp.static(rides):
                    q.carried = s.carried
                if on_surface:
                    q.slot = s.hit.slot
                    if s.collisions == 0:
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


@memoised
def make_flight_point(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, world) -> ScoredPoint`` that draws the point of a flight to be scored."""
    local_albedo = spec.local_albedo
    water, profile = spec.water, spec.water.profile
    water_extinction, water_at = water.extinction, water.at
    sample_flight = make_sample_flight(spec.phase.guide or HENYEY_GREENSTEIN_GUIDE, profile)
    has_profile, collides = profile is not None, spec.scores_collisions
    depth_along = profile.depth if profile is not None else water_extinction  # any function: it is not called
    apparent_lens = make_apparent_lens(spec)

    @wp.func
    def flight_point(request: Request, world: wp.ref[World]) -> ScoredPoint:
        point = ScoredPoint()
        # Layers: a density with the mean extinction; what is scored weighs with the exact one.
        s0 = request.interval[0]
        width = request.interval[1] - s0
        middle = request.x + (0.5 * (s0 + request.interval[1])) * request.u
        begin = request.x + s0 * request.u
        seed = join_words(request.first, request.second)
        from_lens = request.x - apparent_lens(world.camera, middle, request.lens)
        xi_choice = u01(request.first)
        xi = u01_fine(request.second)
        if wp.static(collides):
            if scores_collision(request.first):
                xi = from_bits(int(request.second))
        if wp.static(has_profile):
            flight = sample_flight(
                from_lens, request.u, request.interval, 0.0, world.medium, xi_choice, xi, world.layers, begin
            )
        else:
            mean = water_extinction(world.medium, world.layers, begin, request.u, width, seed)
            flight = sample_flight(from_lens, request.u, request.interval, mean, world.medium, xi_choice, xi)
        point.x = request.x + flight.s * request.u
        point.path = request.path + flight.s
        there = water_at(world.medium, world.layers, point.x)
        weight = float(request.weight)
        if wp.static(local_albedo):
            weight *= there.albedo
        if wp.static(collides):
            # What is scored at collisions has lost light by chance already. Both kinds of points share a density, of
            # about 1/2 c exp(-depth) + 3/4 p(angle): any would do that does not depend on chance (balance heuristic).
            from_angle = 1.5 * flight.density  # half of p
            about = wp.exp(-depth_along(world.medium, world.layers, request.x, request.u, flight.s))
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
                before = depth_along(world.medium, world.layers, request.x, request.u, s0)
            weight *= there.extinction * wp.exp(-before - flight.depth)
        else:
            passed = water_extinction(world.medium, world.layers, request.x, request.u, flight.s, seed)
            weight *= there.extinction * wp.exp(-passed * flight.s)
        point.weight = wp.where(flight.density <= 0.0, 0.0, weight / flight.density)
        return point

    return flight_point


@memoised
def make_point_of(points: int) -> wp.Function:
    """The Warp function ``(request, number) -> Request``: of a flight, that of another of its `points`, at least 2.

    Both random numbers of a point are a part of 1 further than those of the one before, modulo 1: those of each are
    uniform, and together they are spread evenly (systematic sampling). What a pixel's bin holds is noisy above all
    since few flights are scored in it; the points of a flight lie in others.
    """
    step = wp.uint32((1 << 32) // points)

    @wp.func
    def point_of(request: Request, number: int) -> Request:
        other = request
        other.first = request.first + wp.uint32(number) * wp.static(step)
        other.second = request.second + wp.uint32(number) * wp.static(step)
        return other

    return point_of


@memoised
def make_scattering(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, x, v, world) -> float``: density [1/sr] of what the water or the face of the
    request scatters at x into the direction v."""
    has_mesh, specular = spec.mesh, spec.specular
    water_at = spec.water.at
    phase_pdf = spec.phase.pdf
    reflectance_at = spec.reflectance_at
    face_at = patch_face if spec.tries_faces else tree_face

    @wp.func
    def scattering_density(request: Request, x: wp.vec3, v: wp.vec3, world: wp.ref[World]) -> float:
        scattering = float(0.0)
        on_surface = False
        if wp.static(has_mesh):
            on_surface = request.slot >= 0
            if on_surface:
                face, normal = face_at(world.surfaces, request.slot, request.u)
                cos_out = wp.max(wp.dot(v, normal), 0.0)
                scattering = lambert_brdf(reflectance_at(world.surfaces, face, x)) * cos_out
                if wp.static(specular):
                    lobe = ggx_brdf(request.u, v, normal, world.surfaces.roughness[face])
                    scattering += world.surfaces.specular[face] * lobe * cos_out
        if not on_surface:
            snapped = snap_from(request.u, world.medium.axis_threshold)
            scattering = phase_pdf(one_minus_cosine(snapped, v), water_at(world.medium, world.layers, x))
        return scattering

    return scattering_density


@memoised
def make_score(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(request, world) -> Scored`` of next events, with what rides along.

    `flights`: whether requests may ask for a point of a flight.
    """
    confocal, reflecting, merged = spec.confocal, spec.reflecting, spec.merged
    water_extinction, collides = spec.water.extinction, flights and spec.scores_collisions
    image_of = spec.image_of
    flight_point, scattering_density = make_flight_point(spec), make_scattering(spec)
    link_to, value_of = make_link(spec)
    rider = make_rider(spec)
    rides, (_begin, fork, fly, event, _mirror, deliver) = rider is not NOTHING, rider

    @wp.func
    def carry(found: wp.ref[Scored], request: Request, link: Link, world: wp.ref[World], inside: wp.vec3):
        carried = request.carried
        fork(carried, world)
        fly(carried, world, request.x, request.u, wp.length(found.origin - request.x))
        event(carried, world, request.slot, found.origin, request.u, link.to_lens)
        fly(carried, world, found.origin, link.to_lens, link.water)
        deliver(found.contribution, carried, world, link.end, link.to_lens, wp.normalize(inside))

    @wp.func
    def score(request: Request, world: wp.ref[World]) -> Scored:
        found = Scored()
        found.contribution.rounding_sample = u01(request.rounding_sample)
        found.origin = request.x
        weight = float(request.weight)
        path = float(request.path)
        ahead = float(0.0)
        lens = lens_point(world.camera, u01_high(request.first), u01_low(request.first))
        if wp.static(flights):
            if wp.static(reflecting):
                if request.interval[0] >= request.interval[1] and request.slot < 0:
                    return found  # an event in the water, for its reflections alone
            if request.interval[0] < request.interval[1]:
                lens = request.lens
                point = flight_point(request, world)
                found.origin = point.x
                weight = point.weight
                path = point.path
                ahead = point.ahead
        view = world.camera.view
        if wp.static(confocal):
            view = world.scan.view[request.target]
        link = link_to(world.camera, found.origin, lens)
        found.lens = link.end
        pixel = image_of(world.camera, view, request.target, link.image, lens)
        scattering = scattering_density(request, found.origin, link.to_lens, world)
        if pixel >= 0 and not scattering <= 0.0:
            seed = join_words(request.second, request.first)
            if wp.static(collides):
                # The flight up to the point and the way to the lens by one loop: the code is long.
                extinction = float(0.0)
                while ahead >= 0.0:
                    begin = wp.where(ahead > 0.0, request.x, found.origin)
                    u = wp.where(ahead > 0.0, request.u, link.to_lens)
                    length = wp.where(ahead > 0.0, ahead, link.water)
                    extinction = water_extinction(world.medium, world.layers, begin, u, length, seed)
                    weight *= wp.where(ahead > 0.0, wp.exp(-extinction * ahead), 1.0)
                    seed += wp.uint64(0x632BE59BD9B4E019)  # another sequence
                    ahead = wp.where(ahead > 0.0, 0.0, -1.0)
            else:
                extinction = water_extinction(world.medium, world.layers, found.origin, link.to_lens, link.water, seed)
            component = wp.where(wp.static(merged), BALLISTIC, request.component)
            found.contribution.value = value_of(world.camera, extinction, weight, scattering, link)
            found.contribution.index = tally_index(world.camera, world.gate, pixel, path + link.path, component)
            if wp.static(rides):
                if found.contribution.value > 0.0:
                    carry(found, request, link, world, lens - link.image)
        return found

    return score
