"""What a photon adds to a pixel by a next event: from where it scatters, or from a sampled point of its flight."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import from_bits
from spadwarp_kernels.base.philox import join_words, u01, u01_fine, u01_high, u01_low
from spadwarp_kernels.base.rotations import cotangent, one_minus_cosine, snap_from
from spadwarp_kernels.optics.camera import lens_point
from spadwarp_kernels.optics.port import Connection
from spadwarp_kernels.optics.sea import FACETS, passage_density
from spadwarp_kernels.optics.visibility import lens_in_air
from spadwarp_kernels.photon.queue import Request
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import SEA_FACE, SEA_SLOT, Contribution, PhotonState, World
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED, SURFACE
from spadwarp_kernels.water.medium import Layers, Medium, Profile
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN_GUIDE, PhaseGuide

# ---- Points of flights, drawn by distance and angle at once, after Kulla & Fajardo 2012 (equi-angular sampling) and
# Georgiev et al. 2013 (joint distance-angle sampling).


@wp.struct
class FlightSample:
    """A point of a flight: distance s along it, distance r to the lens point [m], its density over s [1/m]; 0 for
    none. With a `Profile` that draws: its optical depth up to there, and the extinction there [1/m]."""

    s: float
    r: float
    density: float
    depth: float
    extinction: float


@wp.func
def _turn(d: float, along: float, r: float) -> wp.vec2:
    """(1 - cos, 1 + cos) of the angle theta = atan2(d, -along), neither as a difference; r^2 = d^2 + along^2."""
    far = r + wp.abs(along)
    small = d * d / (r * far)
    large = far / r
    return wp.where(along < 0.0, wp.vec2(small, large), wp.vec2(large, small))


@memoised
def _make_variable(chord: bool) -> tuple[wp.Function, wp.Function, wp.Function]:
    """The variable of a guide, angle or chord: at a point of the flight ``(d, along, r)``, the point that has it
    ``(d, value)``, and its derivative along the flight ``(d, along, r)``."""

    @wp.func
    def turn_of(d: float, along: float, r: float) -> float:
        if wp.static(chord):
            return wp.sqrt(2.0 * _turn(d, along, r)[0])
        return wp.atan2(d, -along)

    @wp.func
    def along_of(d: float, value: float) -> float:
        if wp.static(chord):
            h = 0.25 * value * value
            return -d * (1.0 - 2.0 * h) / (value * wp.sqrt(wp.max(1.0 - h, 1.0e-12)))
        return -d * cotangent(value)

    @wp.func
    def slope(d: float, along: float, r: float) -> float:
        if wp.static(chord):
            return wp.sqrt(0.5 * _turn(d, along, r)[1]) * d / (r * r)
        return d / (r * r)

    return turn_of, along_of, slope


@memoised
def make_sample_flight(guide: PhaseGuide = HENYEY_GREENSTEIN_GUIDE, profile: Profile | None = None) -> wp.Function:
    """`sample_flight` for a guide. Its extinction is read without a profile; its layers, and the point where the
    interval begins, with one. With a profile that draws nothing xi is the distance to the collision unless the point is
    to be drawn from the angle, and the density is that of the angle alone."""
    has_profile, draws = profile is not None, profile is not None and profile.draw is not None
    draw = profile.draw if profile is not None and profile.draw is not None else _turn  # any: it is not called
    complement, inverse, guide_density = guide.complement, guide.angle, guide.density
    turn_of, along_of, slope = _make_variable(guide.chord)

    @wp.func
    def sample_flight(
        x: wp.vec3,
        u: wp.vec3,
        interval: wp.vec2,
        extinction: float,
        medium: Medium,
        xi_choice: float,
        xi: float,
        layers: Layers,
        begin_point: wp.vec3,
    ) -> FlightSample:
        """A point of the flight x + s u within the interval, x relative to the lens point.

        Half the points are drawn from exp(-c s), with a profile from c(s) exp(-depth(s)), half in the angle theta(s) =
        atan2(D, t_c - s), D = |x cross u|, by which the light must turn to reach the lens: from the guide, which
        follows the phase function; on flights that lead away from the lens (s0 >= t_c) uniformly in tan(psi/2), psi =
        pi - theta, small far from the lens.
        """
        sample = FlightSample()
        s0 = interval[0]
        s1 = interval[1]
        width = s1 - s0
        t_c = -wp.dot(x, u)
        # The cross product, not |x|^2 - t_c^2, which cancels. The floor keeps float32 angles of a coaxial laser apart.
        d = wp.max(wp.length(wp.cross(x, u)), 1.0e-7)
        kept = 1.0 - wp.exp(-extinction * width)
        thick = extinction * width > 1.0e-4
        first = s0 - t_c
        last = s1 - t_c
        r_first = wp.sqrt(d * d + first * first)
        r_last = wp.sqrt(d * d + last * last)
        away = first >= 0.0
        begin = wp.where(away, d / (r_first + first), complement(turn_of(d, first, r_first), medium))
        end = wp.where(away, d / (r_last + last), complement(turn_of(d, last, r_last), medium))
        span = begin - end
        angular = wp.where(span > 1.0e-7 * begin, 0.5, 0.0)
        s = float(0.0)
        given = float(-1.0)
        if xi_choice < angular:
            g = begin - xi * span
            s = t_c + 0.5 * d * (1.0 - g * g) / g if away else t_c + along_of(d, inverse(g, medium))
            if wp.static(draws):
                given = wp.clamp(s, s0, s1) - s0
        else:
            if wp.static(not has_profile):
                s = s0 + wp.where(thick, -wp.log(1.0 - xi * kept) / extinction, xi * width)
            if wp.static(has_profile and not draws):
                s = xi
        if wp.static(draws):
            drawn = draw(medium, layers, begin_point, u, width, given, xi)
            s = s0 + drawn.s
            sample.depth = drawn.depth
            sample.extinction = drawn.extinction
        s = wp.clamp(s, s0, s1)
        along = s - t_c
        r = wp.sqrt(d * d + along * along)
        if wp.static(draws):
            linear_density = drawn.density
        elif wp.static(has_profile):
            linear_density = 0.0
        else:
            linear_density = wp.where(thick, extinction * wp.exp(-extinction * (s - s0)) / kept, 1.0 / width)
        towards = guide_density(turn_of(d, along, r), medium) * slope(d, along, r)
        angular_density = wp.where(away, d / (r * (r + along)), towards) / wp.max(span, 1.0e-30)
        if angular == 0.0:
            angular_density = 0.0
        sample.s = s
        sample.r = r
        sample.density = (1.0 - angular) * linear_density + angular * angular_density
        return sample

    return sample_flight


# ---- Requests, and what they come to.


@wp.struct
class Scored:
    """What a request comes to."""

    contribution: Contribution  # to the tally, if nothing stands between the scored point and the lens
    origin: wp.vec3  # the scored point [m]
    lens: wp.vec3  # where its light leaves the water: the point of the lens, or of a port; or meets a sea's surface [m]
    behind: wp.vec3  # by a sea, the point of the lens [m]


@wp.struct
class ScoredPoint:
    """The point of a request."""

    x: wp.vec3  # where it is [m]
    weight: float  # the photon's weight there
    path: float  # up to it [m]
    ahead: float  # of `scores_collisions`, length of the flight up to there that the weight does not account for [m]


@wp.func
def sea_component(s: wp.ref[PhotonState], scatterings: int) -> int:
    """The component of light after so many collisions and targets, which the surface of a sea is none of."""
    component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
    component = wp.where(s.surface_count == 1 and scatterings == 1, BALLISTIC, component)
    return wp.where(scatterings == 0, SURFACE, component)


@wp.func
def ask_at_sea(s: wp.ref[PhotonState], world: wp.ref[World], waves: bool) -> Request:
    """Of a photon at the surface of a sea, for all that the surface sends to the lens, but for what `Sight.link` finds
    from the event before: transmitted light of events that scatter. `waves`: that may have been at the surface, too."""
    q = Request()
    q.wanted = lens_in_air(world.camera) == s.above or s.collisions == 0 or (waves and s.bounces.leg > 1)
    q.x = s.x
    q.u = s.u
    q.weight = s.weight.value
    q.path = s.path
    q.first = s.flight.block[3]
    q.rounding_sample = s.flight.block[2]
    q.slot = SEA_SLOT
    q.target = s.target
    q.component = sea_component(s, s.collisions - s.bounces.count + 1)
    return q


@memoised
def make_event_request(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(s, world) -> Request`` of the event that the photon has come to."""
    sight, reflects, sea = spec.sight, spec.domain.reflects, spec.sight.sea is not None
    tracks, rides = spec.water.profile is not None, make_rider(spec).rides

    @wp.func
    def event_request(s: wp.ref[PhotonState], world: wp.ref[World]) -> Request:
        q = Request()
        on_surface = s.hit.face >= 0
        # Mirrored, any point may be seen.
        if wp.static(not flights or reflects) or on_surface:
            x = sight.pose.point_in(world.scan, s.target, s.x)
            if wp.static(reflects) or sight.shows(
                sight.camera_at(world.camera, world.scan, s.target), sight.view(world.camera, s.view), x
            ):
                q.wanted = True
                if wp.static(reflects):
                    q.wanted = s.bounces.face == 0
                q.x = s.x
                q.u = s.u
                q.weight = s.weight.value
                q.path = s.path
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
                    if s.surface_count == 0:
                        q.component = BACKSCATTER
        if wp.static(sea):
            if s.bounces.face == SEA_FACE:
                q = ask_at_sea(s, world, wp.static(spec.waves))
                if wp.static(rides):
                    q.carried = s.carried
            q.second = s.flight.block[1]  # of the direction to come
            if on_surface and s.collisions == s.bounces.count:
                q.component = BALLISTIC
        return q

    return event_request


@wp.func
def scores_collision(word: wp.uint32) -> bool:
    """Whether a flight is scored at its collision: by the first bit of the first word of its request."""
    return (word >> wp.uint32(31)) > wp.uint32(0)


@memoised
def make_flight_point(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, world) -> ScoredPoint`` that draws the point of a flight to be scored."""
    water, profile, sight = spec.water, spec.water.profile, spec.sight
    sample_flight = make_sample_flight(water.phase.guide or HENYEY_GREENSTEIN_GUIDE, profile)
    has_profile, collides = profile is not None, spec.scores_collisions
    depth_along = profile.depth if profile is not None else water.extinction  # any function: it is not called

    @wp.func
    def flight_point(request: Request, world: wp.ref[World]) -> ScoredPoint:
        point = ScoredPoint()
        # Layers: a density with the mean extinction; what is scored weighs with the exact one.
        s0 = request.interval[0]
        width = request.interval[1] - s0
        middle = request.x + (0.5 * (s0 + request.interval[1])) * request.u
        begin = request.x + s0 * request.u
        seed = join_words(request.first, request.second)
        middle = sight.pose.point_in(world.scan, request.target, middle)
        seen = sight.apparent(sight.camera_at(world.camera, world.scan, request.target), middle, request.lens)
        from_lens = request.x - sight.pose.point_out(world.scan, request.target, seen)
        xi_choice = u01(request.first)
        xi = u01_fine(request.second)
        if wp.static(collides):
            if scores_collision(request.first):
                xi = from_bits(int(request.second))
        mean = float(0.0)
        if wp.static(not has_profile):
            mean = water.extinction(world.medium, world.layers, begin, request.u, width, seed)
        flight = sample_flight(
            from_lens, request.u, request.interval, mean, world.medium, xi_choice, xi, world.layers, begin
        )
        point.x = request.x + flight.s * request.u
        point.path = request.path + flight.s
        there = water.at(world.medium, world.layers, point.x)
        weight = float(request.weight)
        if wp.static(spec.local_albedo):
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
            # The extinction of the draw: beside it in a dense cell, that of a thin one would leave a spike.
            weight *= flight.extinction * wp.exp(-before - flight.depth)
        else:
            passed = water.extinction(world.medium, world.layers, request.x, request.u, flight.s, seed)
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
    water, faces = spec.water, spec.faces
    sea, surface_at = spec.sight.sea is not None, (spec.sight.sea or FACETS).at

    @wp.func
    def scattering_density(request: Request, x: wp.vec3, v: wp.vec3, world: wp.ref[World]) -> float:
        scattering = float(0.0)
        if request.slot >= 0:
            scattering = faces.density(world.surfaces, request.slot, x, request.u, v)
        else:
            snapped = snap_from(request.u, world.medium.axis_threshold)
            scattering = water.phase.pdf(one_minus_cosine(snapped, v), water.at(world.medium, world.layers, x))
        if wp.static(sea):
            if request.slot == SEA_SLOT:
                scattering = passage_density(surface_at(world.sea, x), request.u, v)
        return scattering

    return scattering_density


@memoised
def _make_carry(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(found, request, link, world, inside)``: what rides along with light of a request goes by the
    link to the lens, where it arrives along `inside`, of any length."""
    pose, sea, rider = spec.sight.pose, spec.sight.sea is not None, make_rider(spec)

    @wp.func
    def carry(found: wp.ref[Scored], request: Request, link: Connection, world: wp.ref[World], inside: wp.vec3):
        carried = request.carried
        rider.fork(carried, world)
        to_lens = pose.turn_out(world.scan, request.target, link.to_lens)
        rider.fly(carried, world, request.x, request.u, wp.length(found.origin - request.x))
        rider.event(carried, world, request.slot, found.origin, request.u, to_lens)
        arrives = wp.normalize(inside)
        if wp.static(sea):
            if wp.length_sq(found.behind - found.lens) > 0.0:
                behind = pose.turn_out(world.scan, request.target, arrives)
                rider.event(carried, world, SEA_SLOT, found.lens, to_lens, behind)
            begin = pose.point_out(world.scan, request.target, link.begin)
            rider.fly(carried, world, begin, pose.turn_out(world.scan, request.target, link.along), link.water)
        else:
            rider.fly(carried, world, found.origin, to_lens, link.water)
        rider.deliver(found.contribution, carried, world, link.exit, link.to_lens, arrives)

    return carry


@memoised
def make_score(spec: TransportSpec, flights: bool = False) -> wp.Function:
    """The Warp function ``(request, world) -> Scored`` of next events, with what rides along.

    `flights`: whether requests may ask for a point of a flight.
    """
    reflects, collides, water = spec.domain.reflects, flights and spec.scores_collisions, spec.water
    flight_point, scattering_density = make_flight_point(spec), make_scattering(spec)
    sight, pose, sea, rider = spec.sight, spec.sight.pose, spec.sight.sea is not None, make_rider(spec)
    carry = _make_carry(spec)

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
            if wp.static(reflects):
                if request.interval[0] >= request.interval[1] and request.slot < 0:
                    return found  # an event in the water, for its reflections alone
            if request.interval[0] < request.interval[1]:
                lens = request.lens
                point = flight_point(request, world)
                found.origin = point.x
                weight = point.weight
                path = point.path
                ahead = point.ahead
        view = sight.scan_view(world.camera, world.scan, request.target)
        at_sea = bool(False)
        bits = wp.uint64(0)
        if wp.static(sea):
            at_sea = request.slot == SEA_SLOT
            bits = join_words(request.second, request.first)
        origin = pose.point_in(world.scan, request.target, found.origin)
        camera = sight.camera_at(world.camera, world.scan, request.target)
        surface = sight.sea_at(world.sea, world.scan, request.target)
        link = sight.link(camera, surface, origin, lens, at_sea, bits)
        to_lens = pose.turn_out(world.scan, request.target, link.to_lens)
        found.lens = pose.point_out(world.scan, request.target, link.exit)
        found.behind = pose.point_out(world.scan, request.target, lens)
        pixel = sight.project(world.camera, view, request.target, link.image, lens)
        scattering = scattering_density(request, found.origin, to_lens, world)
        if pixel >= 0 and not scattering <= 0.0 and sight.clear(camera, surface, origin, lens, link):
            seed = join_words(request.second, request.first)
            if wp.static(collides):
                # The flight up to the point and the way to the lens by one loop: the code is long.
                extinction = float(0.0)
                while ahead >= 0.0:
                    begin = wp.where(ahead > 0.0, request.x, found.origin)
                    u = wp.where(ahead > 0.0, request.u, to_lens)
                    length = wp.where(ahead > 0.0, ahead, link.water)
                    extinction = water.extinction(world.medium, world.layers, begin, u, length, seed)
                    weight *= wp.where(ahead > 0.0, wp.exp(-extinction * ahead), 1.0)
                    seed += wp.uint64(0x632BE59BD9B4E019)  # another sequence
                    ahead = wp.where(ahead > 0.0, 0.0, -1.0)
            elif wp.static(sea):
                begin = pose.point_out(world.scan, request.target, link.begin)
                along = pose.turn_out(world.scan, request.target, link.along)
                extinction = water.extinction(world.medium, world.layers, begin, along, link.water, seed)
            else:
                extinction = water.extinction(world.medium, world.layers, found.origin, to_lens, link.water, seed)
            found.contribution.value = sight.value(world.camera, extinction, weight, scattering, link)
            found.contribution.path = path + link.path
            found.contribution.index = spec.tally_index(
                world.camera, world.gate, pixel, found.contribution.path, request.component
            )
            if wp.static(rider.rides):
                if found.contribution.value > 0.0:
                    carry(found, request, link, world, lens - link.image)
        return found

    return score
