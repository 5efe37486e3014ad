"""What the lens sees: a coarse map that answers most shadow rays without a BVH, and the ways of light to it."""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.rotations import cos_sin_turn

from .camera import SCANNED, Camera, Gate, Lens, check_camera, clip_half_space, clip_to_view, field, lens_point
from .laser import Pose, Scan, make_pose
from .port import DOME_PORT, FLAT_PORT, Connection, Port, PortKind, PortRay, apparent_centre
from .sea import FACETS, WAVES, Sea, SeaKind

__all__ = ["next_event_value"]

# Texels along each side of the field of view: fine against the relief of a target, small against a GPU's cache.
_TEXELS = wp.constant(128)
_NOTHING = wp.constant(1.0e30)


@wp.func
def _texel(tangent: float, low: float, high: float) -> float:
    return (tangent - low) / (high - low) * float(_TEXELS)


# In a module of its own: a thread that makes functions of this file changes theirs while another loads this kernel.
@wp.kernel(module="unique", enable_backward=False)
def _near_depth_kernel(camera: Camera, view: wp.vec4, mesh: wp.uint64, threads: int, near_depth: wp.array2d[float]):
    """Lowers each texel of a view to the least depth of the faces that may cover it. Launch: (faces, their threads)."""
    face, thread = wp.tid()
    m = wp.mesh_get(mesh)
    p = m.points[m.indices[3 * face]]
    q = m.points[m.indices[3 * face + 1]]
    r = m.points[m.indices[3 * face + 2]]
    if wp.max(p[2], wp.max(q[2], r[2])) < 0.0:
        return  # behind the lens, and between nothing and it
    depth = wp.min(p[2], wp.min(q[2], r[2]))
    edge = float(_TEXELS)
    box = wp.vec4i(0, 0, int(_TEXELS - 1), int(_TEXELS - 1))
    if depth > camera.aperture_radius:
        # A ray to the rim of the lens differs from the line to its centre by less than this, as a tangent; one texel
        # more on each side makes up for rounding.
        spread = camera.aperture_radius / depth
        for i in range(2):
            least = wp.min(p[i] / p[2], wp.min(q[i] / q[2], r[i] / r[2])) - spread
            most = wp.max(p[i] / p[2], wp.max(q[i] / q[2], r[i] / r[2])) + spread
            box[i] = int(wp.clamp(_texel(least, view[i], view[2 + i]) - 1.0, 0.0, edge))
            box[2 + i] = int(wp.clamp(_texel(most, view[i], view[2 + i]) + 1.0, -1.0, edge - 1.0))
    else:
        depth = 0.0  # beside the lens: of its points, only those of the plane tell
    # Also no nearer than its plane: n y >= far for all y of the face. A ray from x to a point o of the lens meets it at
    # a depth z with z n (x / x[2]) + n o (1 - z / x[2]) >= far, the second term being at most the radius of the lens.
    n = wp.normalize(wp.cross(q - p, r - p))
    if wp.dot(n, p) < 0.0:
        n = -n
    far = wp.min(wp.dot(n, p), wp.min(wp.dot(n, q), wp.dot(n, r))) - camera.aperture_radius
    far -= 1.0e-6 * (wp.length(p) + wp.length(q) + wp.length(r))  # rounding
    width = (view[2] - view[0]) / float(_TEXELS)
    height = (view[3] - view[1]) / float(_TEXELS)
    reach = 0.501 * (wp.abs(n[0]) * width + wp.abs(n[1]) * height)
    columns = wp.max(box[2] - box[0] + 1, 0)
    for k in range(thread, columns * wp.max(box[3] - box[1] + 1, 0), threads):
        column = box[0] + k % columns
        row = box[1] + k / columns
        x = view[0] + (float(column) + 0.5) * width
        y = view[1] + (float(row) + 0.5) * height
        slope = n[0] * x + n[1] * y + n[2] + reach + 1.0e-6  # the largest in the texel
        if far <= 0.0:
            wp.atomic_min(near_depth, row, column, depth)
        elif slope > 0.0:
            wp.atomic_min(near_depth, row, column, wp.max(depth, far / slope))


def near_depth_map(mesh: wp.Mesh, camera: Camera, near_depth: wp.array | None = None) -> wp.array:
    """Least depth [m] at which a face of the mesh can stand in each part of the view, float32 [rows, columns], anew or
    in place; raises `ArgumentError` for a camera that images nothing.

    A point of the view that lies before it is seen from everywhere on the lens: the segments to the lens stay within
    the texel's cone, up to what the outlines of faces are widened by, and before every face in it.
    """
    check.kind("mesh", mesh, wp.Mesh)
    check_camera("camera", camera, calibrated=False)
    shape = (int(_TEXELS), int(_TEXELS))
    near_depth = wp.empty(shape, dtype=float, device=mesh.device) if near_depth is None else near_depth
    check.array("near_depth", near_depth, wp.float32, shape, mesh.device).fill_(_NOTHING)
    view = field(camera) if camera.view[2] == camera.view[0] else camera.view
    # A warp for each face on a GPU: some cover all of the map.
    threads = 32 if mesh.device.is_cuda else 1
    faces = (mesh.indices.size // 3, threads)
    wp.launch(_near_depth_kernel, faces, [camera, view, mesh.id, threads], [near_depth], device=mesh.device)
    return near_depth


@wp.func
def may_be_hidden(view: wp.vec4, near_depth: wp.array2d[float], x: wp.vec3) -> bool:
    """Whether something may stand between x, x[2] > 0, and the lens, as of points beside the view; False is certain."""
    if near_depth.shape[0] == 0:
        return True
    column = _texel(x[0] / x[2], view[0], view[2])
    row = _texel(x[1] / x[2], view[1], view[3])
    edge = float(_TEXELS)
    if not (column >= 0.0 and row >= 0.0 and column < edge and row < edge):
        return True
    return x[2] >= near_depth[int(row), int(column)]


# ---- What a camera sees of the water behind a port: parts of flights that hold all of it, and a little more, which is
# rejected by its pixel: densities may be too wide, not too narrow.


@wp.func
def _side(view: wp.vec4, k: int) -> wp.vec3:
    """Side plane k of a view (left, top, right, bottom): a normal outwards, for planes through the origin."""
    if k == 0:
        return wp.vec3(-1.0, 0.0, view[0])
    if k == 1:
        return wp.vec3(0.0, -1.0, view[1])
    if k == 2:
        return wp.vec3(1.0, 0.0, -view[2])
    return wp.vec3(0.0, 1.0, -view[3])


@wp.func
def _view_from(camera: Camera, view: wp.vec4, o: wp.vec3) -> wp.vec4:
    """Tangents of the directions in which the lens point o sees the view."""
    x = camera.inverse_focus * o[0]
    y = camera.inverse_focus * o[1]
    return wp.vec4(view[0] - x, view[1] - y, view[2] - x, view[3] - y)


@wp.func
def _nearer(port: Port, beyond: float, end: int) -> float:
    """By how much a point is seen nearer than it is, along the normal [m]: rays go as if straight to a point whose
    depths in glass and water are shorter by the ratio of the tangents, here the least (end 0) or the largest (1)."""
    return port.thickness * (port.glass_slope[end] - 1.0) + beyond * (port.water_slope[end] - 1.0)


@wp.func
def clip_to_flat_view(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    """As `clip_to_view` behind a flat port: holds all that the lens point o sees. Of a sea from its highest crest on,
    down to whose deepest trough light may go straight on."""
    port = camera.port
    beyond = wp.dot(x, port.normal) - port.distance - port.thickness + port.amplitude
    climb = wp.dot(u, port.normal)
    seen = _view_from(camera, view, o)
    interval = clip_half_space(beyond, climb, wp.vec2(0.0, limit))
    for k in range(4):
        side = _side(seen, k)
        outward = wp.dot(side, port.normal)
        end = wp.where(outward < 0.0, 1, 0)  # that which widens the view
        slope = port.water_slope[end] - 1.0
        aside = wp.length(side)
        value = (
            -outward * _nearer(port, beyond, end) - wp.dot(side, x - o) + aside * (port.margin * beyond + port.straight)
        )
        rise = -wp.dot(side, u) - outward * climb * slope + aside * port.margin * climb
        interval = clip_half_space(value, rise, interval)
    return interval


@wp.func
def flat_view_shows(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """As `in_view` behind a flat port; False is certain."""
    port = camera.port
    beyond = wp.dot(x, port.normal) - port.distance - port.thickness + port.amplitude
    shown = beyond > 0.0
    for k in range(4):
        side = _side(view, k)
        outward = wp.dot(side, port.normal)
        value = float(-1.0e30)
        for end in range(2):
            near = _nearer(port, beyond, end)
            blur = camera.aperture_radius * wp.abs((x[2] + near * port.normal[2]) * camera.inverse_focus - 1.0)
            value = wp.max(value, blur - outward * near)
        value += wp.length(side) * (port.margin * beyond + port.straight)
        shown = shown and value > wp.dot(side, x)
    return shown


@wp.func
def _dome_side(port: Port, side: wp.vec3) -> wp.vec3:
    """A side plane through the dome's centre that holds all rays, which are bent and pass the centre aside."""
    return wp.normalize(side) - wp.vec3(0.0, 0.0, port.turn)


@wp.func
def clip_to_dome_view(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    """As `clip_to_view` behind a dome: holds all that the lens point o sees."""
    port = camera.port
    seen = _view_from(camera, view, o)
    interval = wp.vec2(0.0, limit)
    for k in range(4):
        side = _dome_side(port, _side(seen, k))
        value = port.aside * (1.0 + port.turn) - wp.dot(side, x - port.centre)
        interval = clip_half_space(value, -wp.dot(side, u), interval)
    return interval


@wp.func
def dome_view_shows(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """As `in_view` behind a dome; False is certain."""
    port = camera.port
    blur = camera.aperture_radius * camera.inverse_focus
    wide = wp.vec4(view[0] - blur, view[1] - blur, view[2] + blur, view[3] + blur)
    y = x - port.centre
    shown = wp.length(y) > port.radius + port.thickness
    for k in range(4):
        shown = shown and wp.dot(_dome_side(port, _side(wide, k)), y) < port.aside * (1.0 + port.turn)
    return shown


# ---- The way of light from a point that is scored to a point of the lens, in water alone or through a port.


@wp.func
def next_event_value(
    camera: Camera, extinction: float, weight: float, scattering: float, to_lens: wp.vec3, distance: float
) -> float:
    """Fraction of the photon that reaches a point of the aperture: w f exp(-c r) A cos(psi)/r^2, f [1/sr], to_lens a
    unit vector."""
    cos_lens = wp.max(-to_lens[2], 0.0)
    # Times -1: Warp's unary minus is 0 - x, an addition.
    passed = wp.exp((-1.0 * extinction) * distance)
    return weight * scattering * passed * camera.aperture_area * cos_lens / (distance * distance)


@wp.struct
class LensSample:
    """A point of the lens [m]; its density if it were uniform, over that of the draw."""

    point: wp.vec3
    weight: float


@memoised
def make_sample_lens(port: PortKind | None) -> wp.Function:
    """The Warp function ``(camera, x, u, xi1, xi2) -> LensSample``: a point of the lens by which the flight x + s u is
    scored.

    The score goes with 1/D, D its distance from the flight's line. Where this, refracted by a port, passes the lens,
    the point is drawn with that density, uniform in angle and distance about the place: even draws would have no finite
    variance. Else it is even.
    """
    has_port, leave = port is not None, (port or FLAT_PORT).leave

    @wp.func
    def sample_lens(camera: Camera, x: wp.vec3, u: wp.vec3, xi1: float, xi2: float) -> LensSample:
        p = wp.vec2(1.0e30, 0.0)
        if wp.static(has_port):
            ray = leave(camera.port, x, wp.where(u[2] < 0.0, u, -u))
            if ray.transmission > 0.0:
                p = wp.vec2(ray.x[0], ray.x[1])
        else:
            s = -x[2] / u[2]
            p = wp.vec2(x[0] + s * u[0], x[1] + s * u[1])
        sample = LensSample()
        sample.point = lens_point(camera, xi1, xi2)
        sample.weight = 1.0
        radius2 = camera.aperture_radius * camera.aperture_radius
        if wp.dot(p, p) < radius2:
            turn = cos_sin_turn(xi2)
            aside = p[0] * turn[1] - p[1] * turn[0]
            to_rim = wp.sqrt(wp.max(radius2 - aside * aside, 0.0)) - wp.dot(p, turn)
            distance = xi1 * to_rim
            sample.point = wp.vec3(p[0] + distance * turn[0], p[1] + distance * turn[1], 0.0)
            sample.weight = 2.0 * to_rim * distance / radius2
        return sample

    return sample_lens


class Sight(NamedTuple):
    """How the lens sees the water, as Warp functions: x and u are of the water, o is a point of the lens; in the frame
    of the camera, see `pose`."""

    port: PortKind | None  # what is between the lens and the water
    project: wp.Function  # this and the next two: see `Lens`
    view: wp.Function
    toward_middle: wp.Function
    scan_view: wp.Function  # ``(camera, scan, target) -> vec4``, the view in which a pixel of a scan, or all, is
    clip: wp.Function  # as `clip_to_view`, holding the part of a flight that lies in the view
    shows: wp.Function  # as `in_view`
    gate: wp.Function  # ``(camera, gate) -> Gate`` of `clip_to_gate`, for what arrives within the gate
    may_hide: wp.Function  # as `may_be_hidden`, of straight lines to a lens that stands still; else True
    leave: wp.Function  # ``(camera, x, u) -> PortRay``, see `PortKind`; without a port straight on
    # ``(camera, sea, x, o, at_sea, seed) -> Connection``; `at_sea`: x is a point of the surface of a sea; `seed`: 64
    # random bits for a sea
    link: wp.Function
    value: wp.Function  # ``(camera, extinction, weight, scattering, link) -> float``, part of the photon that arrives
    apparent: wp.Function  # ``(camera, x, o) -> vec3``, from where the light of o seems to come at x
    toward: wp.Function  # ``(camera, x, o) -> vec3``, unit direction of the way at x; straight where there is no way
    toward_centre: wp.Function  # ``(camera, x) -> vec3``, about that to the lens's centre
    sample_lens: wp.Function  # see `make_sample_lens`
    pose: Pose  # between the frame of the water and that of the camera, in which all of the above is
    # ``(camera, scan, target) -> Camera``: with its port, the mean plane of a sea, in its own frame rather than in that
    # of the water; and ``(sea, scan, target) -> Sea``
    camera_at: wp.Function
    sea_at: wp.Function
    sea: SeaKind | None  # what surface of a sea there is
    # ``(camera, sea, x, o, link) -> bool``, whether no wave of it stands in the way of a link from x to o
    clear: wp.Function


@wp.func
def lens_in_air(camera: Camera) -> bool:
    """Whether the lens of a camera by the sea is in the air: the other side of the surface is denser."""
    return camera.port.index[2] > camera.port.index[0]


@wp.func
def _lies_across(camera: Camera, x: wp.vec3) -> bool:
    """Whether the mean plane of a sea is between x and the lens: all else is seen straight on."""
    return wp.dot(x, camera.port.normal) > camera.port.distance


@memoised
def _make_link(port: PortKind | None) -> tuple[wp.Function, wp.Function]:
    """`leave` and `link` of a `Sight` without a sea."""
    has_port, connect, leave_port = port is not None, (port or FLAT_PORT).connect, (port or FLAT_PORT).leave

    @wp.func
    def leave(camera: Camera, x: wp.vec3, u: wp.vec3) -> PortRay:
        ray = PortRay()
        if wp.static(has_port):
            ray = leave_port(camera.port, x, u)
            ray.seen = ray.x - ray.u
        else:
            ray.seen = x
            ray.u = u
            if u[2] < 0.0:
                ray.water = -x[2] / u[2]
                ray.x = x + ray.water * u
                ray.transmission = 1.0
        return ray

    @wp.func
    def link_to(camera: Camera, sea: Sea, x: wp.vec3, o: wp.vec3, at_sea: bool, seed: wp.uint64) -> Connection:
        link = Connection()
        if wp.static(has_port):
            link = connect(camera.port, x, o)
            link.image = o - link.inside
            link.gather = link.transmission * link.density * wp.max(-link.inside[2], 0.0)
        else:
            to_lens = o - x
            r = wp.length(to_lens)
            link.to_lens = to_lens / r
            link.image = x
            link.exit = o
            link.water = r
            link.path = r
        return link

    return leave, link_to


@memoised
def _make_ways(port: PortKind | None, sea: SeaKind | None) -> tuple[wp.Function, ...]:
    """What `Sight` has from `value` to `toward_centre`."""
    bends, by_sea = port is not None or sea is not None, sea is not None
    connect, apparent_of = (port or FLAT_PORT).connect, (port or FLAT_PORT).apparent

    @wp.func
    def value_of(camera: Camera, extinction: float, weight: float, scattering: float, link: Connection) -> float:
        if wp.static(bends):
            return weight * scattering * wp.exp(-extinction * link.water) * camera.aperture_area * link.gather
        return next_event_value(camera, extinction, weight, scattering, link.to_lens, link.water)

    @wp.func
    def apparent(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
        seen = wp.vec3(o)
        if wp.static(bends) and (wp.static(not by_sea) or _lies_across(camera, x)):
            way = connect(camera.port, x, o)
            if way.density > 0.0:
                seen = apparent_of(camera.port, x, o, way)
        return seen

    @wp.func
    def toward(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec3:
        straight = wp.normalize(o - x)
        if wp.static(bends) and (wp.static(not by_sea) or _lies_across(camera, x)):
            way = connect(camera.port, x, o)
            straight = wp.where(way.density > 0.0, way.to_lens, straight)
        return straight

    @wp.func
    def toward_centre(camera: Camera, x: wp.vec3) -> wp.vec3:
        if wp.static(bends) and (wp.static(not by_sea) or _lies_across(camera, x)):
            return wp.normalize(apparent_centre(camera.port) - x)
        return (-1.0 / wp.max(wp.length(x), 1.0e-30)) * x

    return value_of, apparent, toward, toward_centre


# ---- The surface of a sea.


@memoised
def _make_sea_link(sea: SeaKind) -> wp.Function:
    """`Sight.link` with the surface of a sea."""
    connect, is_above = sea.connect, sea.is_above

    @wp.func
    def link_to(camera: Camera, sea: Sea, x: wp.vec3, o: wp.vec3, at_sea: bool, seed: wp.uint64) -> Connection:
        link = Connection()
        in_air = lens_in_air(camera)
        air = float(0.0)
        if not at_sea and is_above(sea, x) != in_air:
            link = connect(sea, camera.port, x, o, seed)
            rest = wp.length(o - link.exit)
            link.image = o - link.inside
            link.begin = wp.where(in_air, x, link.exit)
            link.along = wp.where(in_air, link.to_lens, link.inside)
            air = wp.where(in_air, rest, link.water)
            link.water = wp.where(in_air, link.water, rest)
            link.gather = link.transmission * link.density * wp.max(-link.inside[2], 0.0)
        else:
            to_lens = o - x
            r = wp.length(to_lens)
            link.to_lens = to_lens / r
            link.image = x
            link.exit = o
            link.begin = x
            link.along = link.to_lens
            link.water = wp.where(in_air, 0.0, r)
            air = r - link.water
            link.gather = wp.max(-link.to_lens[2], 0.0) / (r * r)
        link.path = link.water + sea.delay * air
        link.gather *= wp.exp(-sea.extinction * air)
        return link

    return link_to


@memoised
def _make_clear(sea: SeaKind, waves: bool) -> wp.Function:
    """See `Sight.clear`. A way by the surface is followed from there to both ends: to the surface it would end there by
    rounding, or not."""
    distance = sea.distance

    @wp.func
    def clear(camera: Camera, sea: Sea, x: wp.vec3, o: wp.vec3, link: Connection) -> bool:
        if wp.static(not waves):
            return True
        if link.gather <= 0.0:
            return False
        in_air = lens_in_air(camera)
        rest = o - link.exit
        length = wp.length(rest)
        if length > 0.0:
            back = link.exit - x
            way = wp.length(back)
            free = distance(sea, link.exit, -link.to_lens, not in_air, way) > way
            return free and distance(sea, link.exit, rest / length, in_air, length) > length
        way = wp.length(o - x)
        return distance(sea, x, link.to_lens, in_air, way) > way

    return clear


@memoised
def _make_sea_view(shows: wp.Function) -> tuple[wp.Function, ...]:
    """`clip` and `shows` of a `Sight` with the surface of a sea, for flights in the water; `shows` of the lens."""

    @wp.func
    def clip(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
        interval = wp.vec2()
        if lens_in_air(camera):
            interval = clip_to_flat_view(camera, view, x, u, o, limit)
        else:
            interval = clip_to_view(camera, view, x, u, o, limit)
        return interval

    @wp.func
    def shows_point(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
        shown = bool(True)
        if not _lies_across(camera, x):
            shown = shows(camera, view, x)
        elif lens_in_air(camera):
            shown = flat_view_shows(camera, view, x)
        # Some of the water is above the mean plane.
        return shown or wp.abs(wp.dot(x, camera.port.normal) - camera.port.distance) < camera.port.amplitude

    return clip, shows_point


# Of what lies behind a kind of port: `clip` and `shows`.
_VIEWS = {
    FLAT_PORT.name: (clip_to_flat_view, flat_view_shows),
    DOME_PORT.name: (clip_to_dome_view, dome_view_shows),
}


@memoised
def _make_placed(pose: Pose, moves: bool, waves: bool) -> tuple[wp.Function, wp.Function]:
    """`camera_at` and `sea_at` of a `Sight`; `moves`: the camera does, over a sea; `waves`: with waves."""
    turn_in, point_in = pose.turn_in, pose.point_in

    @wp.func
    def camera_at(camera: Camera, scan: Scan, target: int) -> Camera:
        if wp.static(moves):
            camera.port.distance -= wp.dot(wp.transform_get_translation(scan.pose[target]), camera.port.normal)
            camera.port.normal = turn_in(scan, target, camera.port.normal)
        return camera

    @wp.func
    def sea_at(sea: Sea, scan: Scan, target: int) -> Sea:
        if wp.static(moves):
            sea.height -= wp.dot(wp.transform_get_translation(scan.pose[target]), sea.normal)
            sea.normal = turn_in(scan, target, sea.normal)
            sea.along = turn_in(scan, target, sea.along)
            sea.spread_along = turn_in(scan, target, sea.spread_along)
            if wp.static(waves):
                sea.waves.normal = sea.normal
                sea.waves.origin = point_in(scan, target, sea.waves.origin)
                sea.waves.columns = turn_in(scan, target, sea.waves.columns)
                sea.waves.rows = turn_in(scan, target, sea.waves.rows)
        return sea

    return camera_at, sea_at


@memoised
def make_sight(lens: Lens, port: PortKind | None, confocal: bool, sea: SeaKind | None = None) -> Sight:
    """For a way of imaging, a kind of port or None, and whether pixels are scanned; `sea`: the surface of a sea, and no
    port."""
    moves, waves = lens.name == SCANNED.name, sea is not None and sea.name == WAVES.name
    bends = port is not None or sea is not None

    @wp.func
    def scan_view(camera: Camera, scan: Scan, target: int) -> wp.vec4:
        view = camera.view
        if wp.static(confocal and not moves):
            view = scan.view[target]
        return view

    @wp.func
    def gate_of(camera: Camera, gate: Gate) -> Gate:
        """For the least and the largest time that a port may save against the straight line."""
        wide = gate
        if wp.static(bends):
            wide.start = gate.start - camera.port.late
            wide.stop = gate.stop + camera.port.early
        return wide

    @wp.func
    def may_hide(view: wp.vec4, near_depth: wp.array2d[float], x: wp.vec3) -> bool:
        return wp.static(bends or moves) or may_be_hidden(view, near_depth, x)

    leave, link = _make_link(port)
    ways = (leave, _make_sea_link(sea) if sea else link, *_make_ways(port, sea))
    view = _make_sea_view(lens.shows) if sea else _VIEWS[port.name] if port else (clip_to_view, lens.shows)
    imaging = (lens.project, lens.view, lens.toward_middle, scan_view)
    pose = make_pose(moves)
    placed = _make_placed(pose, moves and sea is not None, waves)
    clear = _make_clear(sea or FACETS, waves)
    return Sight(port, *imaging, *view, gate_of, may_hide, *ways, make_sample_lens(port), pose, *placed, sea, clear)
