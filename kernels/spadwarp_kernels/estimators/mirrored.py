"""Next events by way of the faces of the domain: the light of an event that reaches the lens after reflections."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import join_words, u01, u01_high, u01_low
from spadwarp_kernels.optics.camera import lens_point
from spadwarp_kernels.photon.queue import Request
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Contribution, PhotonState, Sink, World, make_deposit, tally_index
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.bvh import segment_meets_box
from spadwarp_kernels.tally.tally import BALLISTIC, FORWARD_SCATTERED
from spadwarp_kernels.water.limits import (
    face_index,
    flipped,
    image_direction,
    image_point,
    image_reflectance,
    next_face,
    reflections_of,
)

from .contribution import make_scattering


@wp.struct
class Mirrored:
    """The light of an event by way of an image, on its way: see `Contribution`; the optical depth so far, whether
    nothing is in between, and the rays that were traced for that."""

    contribution: Contribution
    depth: float
    clear: bool
    shadow_queries: int


@memoised
def _make_follow(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(found, request, x, v, length, reflections, end, inside, world, seed)`` that follows the
    light of a request's event, which leaves x along v in the domain's axes and is reflected so many times within that
    length, to the end of the water, and delivers what rides along."""
    faces, domain, rider = spec.faces, spec.domain, make_rider(spec)

    @wp.func
    def follow(
        found: wp.ref[Mirrored],
        request: Request,
        x: wp.vec3,
        v: wp.vec3,
        length: float,
        reflections: int,
        end: wp.vec3,
        inside: wp.vec3,
        world: wp.ref[World],
        seed: wp.uint64,
    ):
        limits = world.limits
        carried = request.carried
        begin = wp.vec3(x)
        along = wp.vec3(v)
        heading = domain.turn_back(limits, along)
        rest = float(length)
        if wp.static(rider.rides):
            rider.fork(carried, world)
            rider.event(carried, world, request.slot, request.x, request.u, heading)
        for k in range(reflections + 1):
            part = float(rest)
            face = int(0)
            if k < reflections:
                # Less than what stands for none, which is no face.
                leaves = next_face(limits, 9.0e29, begin, along)
                part = wp.min(rest, leaves.distance)
                face = leaves.face
            start = domain.point_back(limits, begin)
            extinction = spec.water.extinction(world.medium, world.layers, start, heading, part, seed + wp.uint64(k))
            found.depth += part * extinction
            if wp.static(rider.rides):
                rider.fly(carried, world, start, heading, part)
            if wp.static(faces.mesh):
                if found.clear and segment_meets_box(start, heading, part, world.surfaces.lower, world.surfaces.upper):
                    found.shadow_queries += 1
                    found.clear = not faces.hides(world.surfaces, start, heading, part)
            begin += part * along
            rest -= part
            if face > 0:
                along = flipped(along, (face - 1) // 2)
                mirrored = domain.turn_back(limits, along)
                if wp.static(rider.rides):
                    rider.mirror(carried, heading, mirrored, face_index(limits.boundary, face))
                heading = mirrored
        if wp.static(rider.rides):
            rider.deliver(found.contribution, carried, world, end, heading, wp.normalize(inside))

    return follow


@memoised
def _make_score_image(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(request, number, world) -> Mirrored`` of an event by way of one of `Boundary.images`."""
    measured = spec.faces.mesh or spec.varies
    followed = measured or make_rider(spec).rides
    sight, domain = spec.sight, spec.domain
    scattering_density, follow = make_scattering(spec), _make_follow(spec)

    @wp.func
    def score_image(request: Request, number: int, world: wp.ref[World]) -> Mirrored:
        found = Mirrored()
        found.clear = True
        limits = world.limits
        image = limits.boundary.images[number]
        x = domain.point(limits, request.x)
        seen = domain.point_back(limits, image_point(limits.lower, limits.upper, image, x))
        lens = lens_point(world.camera, u01_high(request.first), u01_low(request.first))
        view = sight.scan_view(world.camera, world.scan, request.target)
        # The lens, or a port, sees the image as it would see a point in water without an end.
        link = sight.link(world.camera, world.sea, seen, lens, False, wp.uint64(0))
        pixel = sight.project(world.camera, view, request.target, link.image, lens)
        if pixel < 0:
            return found
        along = domain.turn(limits, link.to_lens)
        heading = image_direction(image, along)
        scattering = scattering_density(request, request.x, domain.turn_back(limits, heading), world)
        scattering *= image_reflectance(limits.boundary, image, along)
        if scattering <= 0.0:
            return found
        component = wp.where(request.component == BALLISTIC, FORWARD_SCATTERED, request.component)
        found.contribution.rounding_sample = u01(request.rounding_sample)
        found.contribution.value = 1.0
        extinction = float(world.medium.extinction)
        if wp.static(followed):
            seed = join_words(request.first, wp.uint32(number + 1) << wp.uint32(8))
            follow(
                found, request, x, heading, link.water, reflections_of(image), link.exit, lens - link.image, world, seed
            )
        if wp.static(measured):
            extinction = found.depth / link.water
            scattering = wp.where(found.clear, scattering, 0.0)
        found.contribution.value *= sight.value(world.camera, extinction, request.weight, scattering, link)
        found.contribution.index = tally_index(world.camera, world.gate, pixel, request.path + link.path, component)
        return found

    return score_image


@memoised
def make_score_images(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, request, world, sink)`` that scores a request's event by way of all images; a point of a
    flight is not scored so: events are."""
    score_image, deposit = _make_score_image(spec), make_deposit(spec.signed, 0)

    @wp.func
    def score_images(s: wp.ref[PhotonState], request: Request, world: wp.ref[World], sink: wp.ref[Sink]):
        if request.wanted and request.interval[0] >= request.interval[1]:
            for number in range(world.limits.boundary.images.shape[0]):
                found = score_image(request, number, world)
                s.shadow_queries += found.shadow_queries
                if not found.contribution.value <= 0.0:  # NaN is counted as such
                    s.contributions += 1
                    deposit(s.account, sink, world, found.contribution)

    return score_images
