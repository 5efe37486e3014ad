"""Sums over windows of histogram cubes, and the blend of estimates from several windows by their errors."""

from typing import Any

import warp as wp

__all__ = [
    "blend_kernel",
    "combine_kernel",
    "delay_kernel",
    "deposit_kernel",
    "estimate_kernel",
    "window_sums",
]

_Cube = wp.array3d[wp.vec4]


@wp.kernel(enable_backward=False)
def _sums_kernel(values: _Cube, radius: int, sums: _Cube):
    """Sums over 2 radius + 1 entries of the middle axis; light falls by orders of magnitude over them, of which a sum
    in float32 would leave its rounding. Launch: (outer, inner)."""
    i, k = wp.tid()
    count = values.shape[1]
    total = wp.vec4d()
    for j in range(wp.min(radius, count)):
        total += wp.vec4d(values[i, j, k])
    for j in range(count):
        if j + radius < count:
            total += wp.vec4d(values[i, j + radius, k])
        if j > radius:
            total -= wp.vec4d(values[i, j - radius - 1, k])
        sums[i, j, k] = wp.vec4(total)


def window_sums(values: wp.array, radius: tuple[int, int], work: wp.array, sums: wp.array) -> None:
    """Sums of a cube of vectors `[H, W, T]` over windows of (2 r + 1)² pixels and 2 t + 1 bins, radius = (r, t).

    `work` and `sums`: other arrays of the same shape, written.
    """
    height, width, bins = values.shape
    axes = [((1, height, width * bins), radius[0]), ((height, width, bins), radius[0])] if radius[0] else []
    axes += [((height * width, bins, 1), radius[1])] if radius[1] else []
    source = values
    for left, (shape, reach) in zip(range(len(axes) - 1, -1, -1), axes, strict=True):
        target = work if left % 2 else sums
        inputs: list[Any] = [source.reshape(shape), reach, target.reshape(shape)]
        wp.launch(_sums_kernel, dim=(shape[0], shape[2]), inputs=inputs, device=values.device)
        source = target
    if source is values:
        wp.copy(sums, values)


@wp.kernel(enable_backward=False)
def deposit_kernel(
    time: wp.array2d[wp.float64],
    width: wp.array2d[wp.vec2d],
    light: wp.array2d[wp.vec3],
    first: int,
    known: wp.array3d[float],
    span: wp.array[wp.vec2i],
    covered: wp.array2d[float],
):
    """Rays `[ray, pixel]` into fine bins of pixels from `first` on: three kinds of light, the part of rays that met a
    surface before a bin ends. Launch: (pixel).

    `time`: middle [fine bin], NaN for none; `width`: along both axes of a pixel, over which light spreads; `span`: fine
    bins with light.
    """
    i = wp.tid()
    pixel, rays, count = first + i, time.shape[0], known.shape[2]
    per_bin, low, high = count // covered.shape[1], int(count), int(0)
    for ray in range(rays):
        middle, size = time[ray, i], width[ray, i]
        if wp.isfinite(middle) and middle < wp.float64(count):
            at = int(wp.max(middle, wp.float64(0.0))) // per_bin
            covered[pixel, at] += 1.0 / float(rays)
        if wp.isfinite(middle):
            for side in range(2):  # of the narrow one: two points with its standard deviation, about
                moved = middle + (wp.float64(side) - wp.float64(0.5)) * wp.float64(0.5) * size[1]
                start, stop = moved - wp.float64(0.5) * size[0], moved + wp.float64(0.5) * size[0]
                last = int(wp.ceil(wp.clamp(stop, wp.float64(0.0), wp.float64(count - 1)))) + 1
                begin = int(wp.clamp(start, wp.float64(0.0), wp.float64(count)))
                for k in range(begin, wp.min(last, count)):
                    after = wp.float64(k + 1)
                    risen = wp.clamp(after - start, wp.float64(0.0), wp.float64(1.0))
                    part = risen - wp.clamp(after - stop, wp.float64(0.0), wp.float64(1.0))
                    share = float(wp.float64(0.5) * part / size[0])
                    for kind in range(known.shape[1]):
                        known[pixel, kind, k] += share * light[ray, i][kind]
                if begin < count and stop > wp.float64(0.0):
                    low, high = wp.min(low, begin), wp.max(high, wp.min(last, count))
    for k in range(1, covered.shape[1]):
        covered[pixel, k] += covered[pixel, k - 1]
    span[pixel] = wp.vec2i(low, high)


@wp.kernel(enable_backward=False)
def delay_kernel(
    light: wp.array2d[float],
    span: wp.array[wp.vec2i],
    delay: wp.vec2i,
    per_bin: int,
    start: wp.array[int],
    edges: wp.array[int],
    factor: float,
    rows: wp.array2d[float],
):
    """Adds light `[pixel, fine bin]` that comes later by delay[0] to delay[1] - 1 fine bins, evenly, to rows of bins.

    `edges` of the rows count bins from the pixel's `start`; `span`: fine bins with light. Launch: (pixel).
    """
    pixel = wp.tid()
    first, last, low, high = delay[0], delay[1], span[pixel][0], span[pixel][1]
    scale, count = wp.float64(factor) / wp.float64(last - first), rows.shape[1]
    late, total, row = wp.float64(0.0), wp.float64(0.0), int(0)
    for k in range(low + first, wp.min(high + last, light.shape[1])):
        if k - first < high:
            late += wp.float64(light[pixel, k - first])
        if k - last >= low:
            late -= wp.float64(light[pixel, k - last])
        at = k // per_bin - start[pixel]
        if at >= edges[row + 1] and row < count - 1:
            rows[pixel, row] += float(scale * total)
            total = wp.float64(0.0)
            while row < count - 1 and at >= edges[row + 1]:
                row += 1
        total += late
    rows[pixel, row] += float(scale * total)


@wp.func
def _estimates(own: wp.vec4, sums: wp.vec4) -> wp.vec3:
    """Of both halves, and the variance of their mean; as traced where nothing is predicted."""
    if own[3] == 0.0:
        return wp.vec3(own[0], own[1], own[2])
    ratio = own[3] / wp.max(wp.max(sums[3], own[3]), 1.0e-30)
    return wp.vec3(sums[0] * ratio, sums[1] * ratio, wp.max(sums[2], 0.0) * ratio * ratio)


@wp.func
def _product(own: wp.vec4, first: float, second: float) -> float:
    """Whose expectation is the squared bias: the halves are independent."""
    return (first - own[0]) * (second - own[1])


@wp.kernel(enable_backward=False)
def estimate_kernel(values: _Cube, sums: _Cube, risk: _Cube):
    """Squared bias, variance and squared prediction of the estimates from a window. Launch: the cube's shape.

    `values`: first half, second half, variance of their mean, prediction; `sums`: these over the window.
    """
    i, j, k = wp.tid()
    own = values[i, j, k]
    found = _estimates(own, sums[i, j, k])
    risk[i, j, k] = wp.vec4(_product(own, found[0], found[1]), found[2], own[3] * own[3], 0.0)


@wp.kernel(enable_backward=False)
def blend_kernel(values: _Cube, sums: _Cube, risk: _Cube, blended: _Cube):
    """Adds a window's estimates by their squared error, `risk` around the voxel. Launch: the cube's shape.

    `blended`: first half, second half, standard deviation of their mean, weights.
    """
    i, j, k = wp.tid()
    found, around = _estimates(values[i, j, k], sums[i, j, k]), risk[i, j, k]
    own = values[i, j, k][3]
    error = (wp.max(around[0], 0.0) + around[1]) / wp.max(wp.max(around[2], own * own), 1.0e-30)
    weight = 1.0 / (error * error + 1.0e-10)
    blended[i, j, k] += weight * wp.vec4(found[0], found[1], wp.sqrt(found[2]), 1.0)


@wp.kernel(enable_backward=False)
def combine_kernel(values: _Cube, blended: _Cube, risk: _Cube):
    """Divides by the weights. Of the blend: bias², variance, prediction², bias⁴. Launch: as the cube."""
    i, j, k = wp.tid()
    own, found = values[i, j, k], blended[i, j, k] / wp.max(blended[i, j, k][3], 1.0e-30)
    blended[i, j, k] = found
    bias, expected = _product(own, found[0], found[1]), own[3] * own[3]
    risk[i, j, k] = wp.vec4(bias, found[2] * found[2], expected, bias * bias)
