"""A raster that beam and pixel scan together."""

import warp as wp


@wp.struct
class Scan:
    """A raster that laser and pixel walk together: photon id belongs to position id mod `count`.

    Attributes:
        count: Number of positions; position i is scored into pixel i.
        axis: Unit vector of the beam at each.
        view: Tangents (left, top, right, bottom) of what each position's pixel sees; a box that holds it.
    """

    count: int
    axis: wp.array(dtype=wp.vec3)
    view: wp.array(dtype=wp.vec4)
