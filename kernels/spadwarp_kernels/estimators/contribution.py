"""What a photon adds to a pixel by a next event: from where it scatters, or from a sampled point of its flight."""

import functools
from typing import Any

import warp as wp

from spadwarp_kernels.intersect.bvh import face_in, face_normal
from spadwarp_kernels.math.bits import bits_of, from_bits
from spadwarp_kernels.math.rotations import one_minus_cosine, snap_direction
from spadwarp_kernels.medium.layers import HOMOGENEOUS, LAYERED, Layers
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.phase.henyey_greenstein import HENYEY_GREENSTEIN_GUIDE
from spadwarp_kernels.photon.lanes import GATHERED, shelf
from spadwarp_kernels.random.philox import u01, u01_fine, u01_high, u01_last, u01_low
from spadwarp_kernels.sensor.camera import Camera, lens_point
from spadwarp_kernels.sensor.gate import Gate, gate_bin
from spadwarp_kernels.source.scan import Scan
from spadwarp_kernels.surface.ggx import ggx_brdf
from spadwarp_kernels.surface.mesh import Surfaces, face_reflectance, lambert_brdf, pattern_reflectance

from .guided import make_sample_flight

# What a history's events make of its light: the first axis of the tally.
COMPONENTS = ("ballistic", "forward_scattered", "backscatter")
BALLISTIC, FORWARD_SCATTERED, BACKSCATTER = (wp.constant(i) for i in range(3))


@wp.struct
class Request:
    """What is to be scored; plain enough for another thread to do it.

    Attributes:
        x: Where the photon scatters, or where the flight begins [m].
        u: Its direction until there, or of the flight.
        weight: Of the photon; in water times the albedo, but for flights through layers, whose albedo is that of the
            sampled point.
        path: Geometric path up to x [m].
        lens: The point of the lens, if it has been drawn.
        interval: The part of the flight to take a point from [m]; empty for a scattering.
        first, second: Random words: of the lens's point or, of a flight, of the choice and the place.
        dither: A random word with 8 bits for the tally.
        component: Index into COMPONENTS.
        slot: Of the face that scatters, see `bvh`; -1 for water.
        target: The pixel of a scan, else -1.
    """

    x: wp.vec3
    u: wp.vec3
    weight: float
    path: float
    lens: wp.vec3
    interval: wp.vec2
    first: wp.uint32
    second: wp.uint32
    dither: wp.uint32
    component: int
    slot: int
    target: int


@wp.struct
class Contribution:
    """What a request comes to.

    Attributes:
        value: Fraction of the emitted light, if nothing stands in the way; 0 for what no pixel sees.
        index: Into the tally, see `tally_index`.
        origin: The point that is scored [m].
        lens: The point of the lens [m].
        dither: Uniform in [0, 1).
    """

    value: float
    index: int
    origin: wp.vec3
    lens: wp.vec3
    dither: float


@wp.func
def next_event_value(
    camera: Camera, extinction: float, weight: float, scattering: float, to_lens: wp.vec3, distance: float
) -> float:
    """Fraction of the photon that reaches a point of the aperture: w f exp(-c r) A cos(psi)/r^2, f [1/sr], to_lens a
    unit vector."""
    cos_lens = wp.max(-to_lens[2], 0.0)
    return (
        weight * scattering * wp.exp(-extinction * distance) * camera.aperture_area * cos_lens / (distance * distance)
    )


@wp.func
def tally_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """Index into the tally [component, pixel, bin], or BEFORE or AFTER the gate."""
    k = gate_bin(gate, path)
    if k < 0:
        return k
    return (component * camera.width * camera.height + pixel) * gate.bins + k


@functools.cache
def make_score(spec: Any) -> wp.Function:
    """The Warp function ``(request, medium, layers, camera, gate, surfaces, scan) -> Contribution`` for a
    `TransportSpec` with next events."""
    guided = spec.estimator == "guided"
    layered, specular, confocal = spec.layered, spec.specular, spec.confocal
    local_albedo = layered and not spec.random_albedo
    _, water_extinction, water_at = LAYERED if layered else HOMOGENEOUS
    project = spec.lens[1]
    phase_pdf = spec.phase.pdf
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance
    sample_flight = make_sample_flight(spec.phase.guide or HENYEY_GREENSTEIN_GUIDE)
    has_mesh = spec.mesh

    @wp.func
    def score(
        request: Request,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        surfaces: Surfaces,
        scan: Scan,
    ) -> Contribution:
        found = Contribution()
        found.dither = u01_last(request.dither)
        y = request.x
        weight = float(request.weight)
        path = float(request.path)
        scores_flight = False
        if wp.static(guided):
            found.lens = request.lens
            scores_flight = request.interval[0] < request.interval[1]
        else:
            found.lens = lens_point(camera, u01_high(request.first), u01_low(request.first))
        if wp.static(guided) and scores_flight:
            # Layers: a density with the mean extinction; what is scored weighs with the exact one.
            s0 = request.interval[0]
            flight = sample_flight(
                request.x - request.lens,
                request.u,
                request.interval,
                water_extinction(medium, layers, request.x + s0 * request.u, request.u, request.interval[1] - s0),
                medium,
                u01(request.first),
                u01_fine(request.second),
            )
            y = request.x + flight.s * request.u
            path += flight.s
            there = water_at(medium, layers, y)
            if wp.static(local_albedo):
                weight *= there.albedo
            weight *= there.extinction * wp.exp(
                -water_extinction(medium, layers, request.x, request.u, flight.s) * flight.s
            )
            weight = wp.where(flight.density <= 0.0, 0.0, weight / flight.density)
        found.origin = y
        view = camera.view
        if wp.static(confocal):
            view = scan.view[request.target]
        pixel = project(camera, view, request.target, y, found.lens)
        to_lens = found.lens - y
        r = wp.length(to_lens)
        to_lens = to_lens / r
        scattering = float(0.0)
        on_surface = False
        if wp.static(has_mesh):
            on_surface = request.slot >= 0
            if on_surface:
                face = face_in(surfaces.order, request.slot)
                normal = face_normal(surfaces.faces, request.slot, request.u)
                cos_out = wp.max(wp.dot(to_lens, normal), 0.0)
                scattering = lambert_brdf(reflectance_at(surfaces, face, y)) * cos_out
                if wp.static(specular):
                    scattering += (
                        surfaces.specular[face]
                        * ggx_brdf(request.u, to_lens, normal, surfaces.roughness[face])
                        * cos_out
                    )
        if not on_surface:
            snapped = snap_direction(request.u, medium.axis_threshold)
            scattering = phase_pdf(one_minus_cosine(snapped, to_lens), water_at(medium, layers, y))
        if pixel >= 0 and not scattering <= 0.0:
            found.value = next_event_value(
                camera, water_extinction(medium, layers, y, to_lens, r), weight, scattering, to_lens, r
            )
            found.index = tally_index(camera, gate, pixel, path + r, request.component)
        return found

    return score


@functools.cache
def make_gathering(estimator: str) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions: `shelve(entry, request)`, and `fetch(entry) -> Request` for any thread of the warp."""
    guided = estimator == "guided"

    @wp.func
    def shelve(entry: int, request: Request):
        about = request.component + 4 * (request.slot + 1) + (int(request.dither & wp.uint32(255)) << 8)
        shelf(True, entry, wp.vec4(request.x[0], request.x[1], request.x[2], request.weight))
        shelf(True, entry + GATHERED, wp.vec4(request.u[0], request.u[1], request.u[2], request.path))
        shelf(
            True,
            entry + 2 * GATHERED,
            wp.vec4(
                from_bits(int(request.first)),
                from_bits(int(request.second)),
                from_bits(about),
                from_bits(request.target),
            ),
        )
        if wp.static(guided):
            shelf(
                True,
                entry + 3 * GATHERED,
                wp.vec4(request.interval[0], request.interval[1], request.lens[0], request.lens[1]),
            )

    @wp.func
    def fetch(entry: int) -> Request:
        request = Request()
        a = shelf(False, entry, wp.vec4())
        b = shelf(False, entry + GATHERED, wp.vec4())
        c = shelf(False, entry + 2 * GATHERED, wp.vec4())
        request.x = wp.vec3(a[0], a[1], a[2])
        request.weight = a[3]
        request.u = wp.vec3(b[0], b[1], b[2])
        request.path = b[3]
        request.first = wp.uint32(bits_of(c[0]))
        request.second = wp.uint32(bits_of(c[1]))
        about = bits_of(c[2])
        request.component = about & 3
        request.slot = ((about >> 2) & 63) - 1
        request.dither = wp.uint32(about >> 8)
        request.target = bits_of(c[3])
        if wp.static(guided):
            d = shelf(False, entry + 3 * GATHERED, wp.vec4())
            request.interval = wp.vec2(d[0], d[1])
            request.lens = wp.vec3(d[2], d[3], 0.0)
        return request

    return shelve, fetch
