"""The time gate: arrival times are kept as optical path lengths, path = time * c0 / n_g."""

import warp as wp

__all__ = ["C0", "Gate", "gate_bin"]

C0 = 299_792_458.0


@wp.struct
class Gate:
    """Equal bins of geometric path.

    Attributes:
        start: Path of the gate's begin [m]; bin k covers [start + k w, start + (k + 1) w).
        stop: Path at which it ends [m], before the last bin does if histories may not be as long.
        bins_per_metre: 1/w [1/m].
        bins: Number of bins.
    """

    start: float
    stop: float
    bins_per_metre: float
    bins: int


BEFORE = wp.constant(-1)
AFTER = wp.constant(-2)


@wp.func
def gate_bin(gate: Gate, path: float) -> int:
    """Bin of a path length [m], or BEFORE or AFTER the gate."""
    # Selected rather than branched to: the lanes of a warp go either way.
    k = (path - gate.start) * gate.bins_per_metre
    inside = wp.where(k >= float(gate.bins) or path >= gate.stop, AFTER, int(k))
    return wp.where(path < gate.start, BEFORE, inside)


@wp.func
def clip_to_gate(gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, interval: wp.vec2) -> wp.vec2:
    """The part of the interval [s0, s1] of the flight x + s u whose light arrives within the gate by way of a lens
    point; empty where s0 >= s1.

    The arrival path s + r(s) rises with s, so the gate cuts out an interval: s + r = L at
    s = (L^2 - |x|^2)/(2 (L - t_c)), x from the lens point, t_c = -x.u.
    """
    if interval[0] >= interval[1]:
        return interval

    y = x - lens
    distance = wp.length(y)
    t_c = -wp.dot(y, u)
    to_stop = gate.stop - path
    if to_stop <= distance:
        return wp.vec2(0.0, -1.0)
    lower = interval[0]
    # (L^2 - |x|^2) as a product: the difference of squares would cancel near the gate's end.
    upper = wp.min(interval[1], 0.5 * (to_stop - distance) * (to_stop + distance) / wp.max(to_stop - t_c, 1.0e-12))
    to_start = gate.start - path
    if to_start > distance:
        lower = wp.max(lower, 0.5 * (to_start - distance) * (to_start + distance) / wp.max(to_start - t_c, 1.0e-12))
    return wp.vec2(lower, upper)
