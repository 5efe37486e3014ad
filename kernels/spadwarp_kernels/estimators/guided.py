"""The guided estimator: one next event per flight, and directions drawn towards the lens with some chance.

After Buras & Mayer 2011 (directions towards the detector), Kulla & Fajardo 2012 (equi-angular sampling) and Georgiev et
al. 2013 (joint distance-angle sampling).
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import bits_of
from spadwarp_kernels.base.philox import STREAM_FLIGHT_SAMPLE, join_words, random_block_keyed, u01, u01_fine
from spadwarp_kernels.base.rotations import cos_sin_word, one_minus_cosine, rotate_by, snap_from
from spadwarp_kernels.optics.camera import clip_to_gate, lens_point
from spadwarp_kernels.photon.queue import Request
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState, World
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.reflectance import sample_cosine_law
from spadwarp_kernels.tally.tally import BACKSCATTER, FORWARD_SCATTERED
from spadwarp_kernels.water import phase_functions
from spadwarp_kernels.water.medium import Medium
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN, HENYEY_GREENSTEIN_GUIDE, Guiding, PhaseFunction

from .contribution import make_event_request, make_score, scores_collision
from .estimator import Direction, Estimator, FlightPlan, Meeting

# A photon's weight is at most this times its analog weight, see `guided_part`.
LARGEST_WEIGHT_RATIO = wp.constant(64.0)

# With delta tracking, of the flights of backscattered light that pass the lens far aside one in so many is scored, a
# power of two.
ASIDE_SCORED_IN = 16


def make_guided(spec: TransportSpec) -> Estimator:
    """Water is scored at a point of each flight, surfaces where they are hit."""
    request_flight, request_event = make_requests(spec)
    return Estimator(
        plan_flight=make_plan_flight(spec),
        meet=make_choose_meeting(spec) if spec.chooses_meetings else None,
        request_flight=request_flight,
        request_event=request_event,
        score=make_score(spec, flights=True),
        direct=make_direct(spec),
    )


def make_plan_flight(spec: TransportSpec) -> wp.Function:
    """The part of a flight that the view and the gate show by way of a point of the lens."""
    sight, sea, has_phase_guide = spec.sight, spec.sight.sea is not None, spec.water.phase.guide is not None
    within = spec.domain.within

    @wp.func
    def plan_flight(s: wp.ref[PhotonState], block: wp.vec4ui, world: wp.ref[World]) -> FlightPlan:
        plan = FlightPlan()
        x = sight.pose.point_in(world.scan, s.target, s.x)
        u = sight.pose.turn_in(world.scan, s.target, s.u)
        if wp.static(has_phase_guide):
            # The direction was drawn for this point, see `make_direct`.
            plan.lens = lens_point(world.camera, u01(block[2]), u01(block[3]))
            plan.lens_weight = 1.0
        else:
            lens = sight.sample_lens(world.camera, x, u, u01(block[2]), u01(block[3]))
            plan.lens = lens.point
            plan.lens_weight = lens.weight
        limit = within(world.limits, world.limits.max_path - s.path, s.x, s.u)
        if wp.static(sea):
            limit = wp.where(s.above, -1.0, wp.min(limit, s.flight.sea))
        camera = sight.camera_at(world.camera, world.scan, s.target)
        plan.interval = sight.clip(camera, sight.view(world.camera, s.view), x, u, plan.lens, limit)
        gate = sight.gate(world.camera, world.gate)
        plan.interval = clip_to_gate(gate, x, u, s.path, plan.lens, plan.interval)
        if not (wp.static(spec.varies) or world.medium.extinction > 0.0):
            plan.interval = wp.vec2(0.0, 0.0)
        return plan

    return plan_flight


def make_choose_meeting(spec: TransportSpec) -> wp.Function:
    """Light on its way to the first surface in view, through a transmittance T, that would collide before it reaches it
    with the chance sqrt(T) (1 - sqrt(T))/2 nevertheless: in turbid water few photons do, and all light of the target
    comes from them. More would take too many from the light that the water scatters back."""
    water = spec.water

    @wp.func
    def choose_meeting(s: wp.ref[PhotonState], world: wp.ref[World], distance: float) -> Meeting:
        end = Meeting()
        end.meets = distance < s.flight.distance
        end.factor = 1.0
        interval = s.flight.interval
        planned = interval[0] < interval[1] and interval[0] <= distance and distance <= interval[1]
        if planned and s.surface_count == 0:
            seed = join_words(s.flight.block[0], s.flight.block[2])
            extinction = water.extinction(world.medium, world.layers, s.x, s.u, distance, seed)
            root = wp.exp(-0.5 * extinction * distance)
            # Within the bound of weights of `guided_part`; in steps of 1/256, for the last 8 bits of a word, which
            # `u01` leaves.
            chance = wp.min(0.5 * root * (1.0 - root), 1.0 - s.weight.value / (LARGEST_WEIGHT_RATIO * s.analog_weight))
            steps = wp.floor(256.0 * wp.max(chance, 0.0))
            # A single step is coarse, and over so many attenuation lengths its light would be less than a tally's unit.
            steps = wp.where(root < 0.5 and steps < 2.0, 0.0, steps)
            chance = steps / 256.0
            end.meets = end.meets or float(s.flight.sample_block[3] & wp.uint32(0xFF)) < steps
            reached = root * root / wp.max(root * root * (1.0 - chance) + chance, 1.0e-30)
            end.factor = wp.where(end.meets, reached, 1.0 / (1.0 - chance))
        return end

    return choose_meeting


@wp.func
def leads_aside(s: wp.ref[PhotonState]) -> bool:
    """Whether a flight after collisions alone turns by more than 26 degrees (cosine 0.9) to the lens, from any of its
    points: the angle is least at the first.

    Such flights are a third of what is scored; they bring weak, even scores, and next to nothing of the variance of
    bins where it is large.
    """
    return s.collisions > 0 and s.surface_count == 0 and wp.dot(s.x, s.u) > -0.9 * wp.length(s.x)


def make_requests(spec: TransportSpec) -> tuple[wp.Function, wp.Function]:
    """Of the flight, from which `make_score` takes a point, and of the surface at its end."""
    rides, collides = make_rider(spec).rides, spec.scores_collisions
    spares = collides and not spec.domain.reflects  # mirrored, any flight may lead to an image of the lens

    @wp.func
    def request_flight(s: wp.ref[PhotonState]) -> Request:
        q = Request()
        q.wanted = True
        q.x = s.x
        q.u = s.u
        # In this order, so that layers of one water have the bits of that water.
        q.weight = s.flight.lens_weight * s.weight.value
        q.weight = wp.where(wp.static(spec.local_albedo), q.weight, q.weight * s.albedo)
        q.path = s.path
        q.lens = s.flight.lens
        q.interval = s.flight.interval
        q.first = s.flight.sample_block[0]
        q.second = s.flight.sample_block[1]
        if wp.static(collides):
            # Half of the collisions in the interval are scored. The other flights are scored at a point drawn from the
            # angle, those that might have been scored at their collision with twice the weight.
            collision = s.flight.interval[0] <= s.flight.distance and s.flight.distance < s.flight.interval[1]
            if collision and scores_collision(q.first):
                q.second = wp.uint32(bits_of(s.flight.distance))
            else:
                q.weight *= wp.where(collision, 2.0, 1.0)
                q.first = (q.first << wp.uint32(1)) >> wp.uint32(1)
        if wp.static(spares):
            if leads_aside(s):
                # By bits that neither the flight nor its score depends on.
                q.wanted = (s.flight.block[3] & wp.uint32(wp.static(ASIDE_SCORED_IN - 1))) == wp.uint32(0)
                q.weight *= wp.static(float(ASIDE_SCORED_IN))
        q.rounding_sample = s.flight.block[1]  # of the direction to come
        q.component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
        q.slot = -1
        q.target = s.target
        if wp.static(rides):
            q.carried = s.carried
        return q

    return request_flight, make_event_request(spec, flights=True)


@memoised
def make_sample_angle(phase: PhaseFunction) -> wp.Function:
    """The Warp function ``(word, to_lens, directed, here, medium, guiding) -> float``: t = 1 - cos(theta) from the axis
    of the lobe towards the lens, of other directed light (back into the view), or of what the water scatters."""
    guide, one_family = phase.guide or HENYEY_GREENSTEIN_GUIDE, phase.name == HENYEY_GREENSTEIN.name

    @wp.func
    def sample_angle(
        word: wp.uint32, to_lens: bool, directed: bool, here: Medium, medium: Medium, guiding: Guiding
    ) -> float:
        xi = u01_fine(word)
        if wp.static(one_family):
            # One draw for both: the lanes of a warp take theirs together.
            t = phase_functions.sample_henyey_greenstein(
                xi, wp.where(directed, guiding.return_anisotropy, here.anisotropy)
            )
        else:
            t = phase.sample(xi, here)
        if to_lens:
            t = guide.lobe_sample(xi, medium, guiding)
        elif wp.static(not one_family) and directed:
            t = phase_functions.sample_henyey_greenstein(xi, guiding.return_anisotropy)
        return t

    return sample_angle


@wp.func
def guided_part(weight: float, analog_weight: float, surfaces_met: int, probability: float) -> float:
    """By which an event multiplies the probability that it guides its direction, in [0, 1].

    A direction that is left to the physics multiplies the weight by up to 1/(1 - probability), and with it the second
    moment of all scores to come: guiding pays where they are few beside the flight that it improves. A photon that has
    met m surfaces is probably in a vessel and meets about as many again, with a share of the light that is its analog
    weight a: the part 1/(1 + a (m - 1)). In a white vessel the weights of undirected photons, which were
    (1 - probability)^-m, then grow as m^probability.

    The ratio r of weight to analog weight is bounded, too, by R = LARGEST_WEIGHT_RATIO: a probability of at most
    1 - r/R leaves r <= R. The second moment of a score r f is then at most R times that of the walk without guiding,
    E[r^2 f^2] <= R E[r f^2], whatever the water, its layers and the surfaces.

    Args:
        weight, analog_weight: Of the photon; > 0.
        surfaces_met: Surfaces up to and including this event.
        probability: That of all guided directions together, in [0, 1).
    """
    vessel = analog_weight * float(wp.max(surfaces_met - 1, 0))
    bound = 1.0 - weight / (LARGEST_WEIGHT_RATIO * analog_weight)
    return wp.clamp(bound / wp.max(probability, 1.0e-6), 0.0, 1.0 / (1.0 + vessel))


def make_direct(spec: TransportSpec) -> wp.Function:
    """Directions towards the lens, or back into the view, with some chance; the weight makes up for it."""
    water, phase, sight, pose = spec.water, spec.water.phase, spec.sight, spec.sight.pose
    guide, has_phase_guide = phase.guide or HENYEY_GREENSTEIN_GUIDE, phase.guide is not None
    sample_angle, tracks, collides = make_sample_angle(phase), water.profile is not None, spec.scores_collisions

    @wp.func
    def direct(
        s: wp.ref[PhotonState], reflected: wp.vec3, lobe: float, world: wp.ref[World], id: wp.uint64
    ) -> Direction:
        new = Direction()
        on_surface = s.hit.face >= 0
        x = pose.point_in(world.scan, s.target, s.x)
        here = water.at(world.medium, world.layers, s.x)
        # On surfaces for what the water scatters on the way to the lens: where it is clear there is nothing to gain.
        extinction = float(0.0)
        if wp.static(not tracks):
            extinction = here.extinction
        elif on_surface:  # else no cell need be looked up
            extinction = water.at(world.medium, world.layers, s.x).extinction
        at_surface = world.guiding.surface_probability * wp.min(2.0 * extinction * wp.length(x), 1.0)
        to_lens_chance = world.guiding.probability
        if wp.static(collides):
            # Two chances for light that flies back: what comes late through a cloud has turned in several steps, and
            # such histories are few and heavy. A grid that repeats layers has the histories of layers, and one chance.
            u = pose.turn_in(world.scan, s.target, s.u)
            to_lens_chance = wp.where(u[2] < 0.0, to_lens_chance * (2.0 - to_lens_chance), to_lens_chance)
        to_lens_chance = wp.where(on_surface, at_surface, to_lens_chance)
        # Light that goes straight to the lens and arrives before the gate is not worth a chance.
        if s.path + wp.length(x) < sight.gate(world.camera, world.gate).start:
            to_lens_chance = 0.0
        met = s.surface_count + wp.where(on_surface, 1, 0)
        snapped = snap_from(s.u, world.medium.axis_threshold)
        camera = sight.camera_at(world.camera, world.scan, s.target)
        v = sight.toward_centre(camera, x)
        if wp.static(has_phase_guide):
            # To the point of the lens at which the flight to come will be scored: a lobe about the lens's centre could
            # not have a peak narrower than the lens.
            ahead = random_block_keyed(world.keys, id, wp.uint32(s.collisions + 1), STREAM_FLIGHT_SAMPLE)
            v = sight.toward(camera, x, lens_point(world.camera, u01(ahead[2]), u01(ahead[3])))
        v = pose.turn_out(world.scan, s.target, v)
        view = sight.view(world.camera, s.view)
        way = sight.toward_middle(view, x)
        to_axis = wp.vec3()
        to_view_chance = float(0.0)
        if wp.dot(way, way) > 0.0 and not sight.shows(camera, view, x):
            to_view_chance = world.guiding.return_probability
            way *= 1.0 / wp.length(way)
            to_axis = pose.turn_out(world.scan, s.target, wp.vec3(way[0], way[1], 0.0))
        part = guided_part(s.weight.value, s.analog_weight, met, to_lens_chance + to_view_chance)
        to_lens_chance *= part
        to_view_chance *= part
        choice = u01(s.flight.block[3])
        to_lens = choice < to_lens_chance
        directed = choice < to_lens_chance + to_view_chance
        axis = wp.where(on_surface, s.hit.normal, snapped)
        axis = wp.where(to_lens, v, wp.where(directed, to_axis, axis))
        t = sample_angle(s.flight.block[1], to_lens, directed, here, world.medium, world.guiding)
        # Selected rather than branched to, so that what is left out stays in no register.
        t = wp.where(on_surface and not directed, sample_cosine_law(u01(s.flight.block[1])), t)
        new.u = rotate_by(axis, t, cos_sin_word(s.flight.block[2]))
        if wp.static(spec.faces.specular):
            if on_surface and not directed:
                new.u = reflected
        density = phase.pdf(one_minus_cosine(snapped, new.u), here)
        density = spec.faces.pdf(world.surfaces, s.hit, s.u, new.u, lobe, density)
        mixture = (1.0 - to_lens_chance - to_view_chance) * density
        mixture += to_lens_chance * guide.lobe_pdf(one_minus_cosine(v, new.u), world.medium, world.guiding)
        mixture += to_view_chance * phase_functions.henyey_greenstein_pdf(
            one_minus_cosine(to_axis, new.u), world.guiding.return_anisotropy
        )
        new.factor = density / wp.max(mixture, 1.0e-30)
        return new

    return direct
