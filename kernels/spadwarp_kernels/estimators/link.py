"""The way of light from a point that is scored to a point of the lens, in water alone or through a port."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.photon.spec import TransportSpec

__all__ = ["next_event_value"]


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
