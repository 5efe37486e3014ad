"""The time gate: arrival times are kept as optical path lengths, path = time * c0 / n_g."""

import warp as wp

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
    if path < gate.start:
        return BEFORE
    k = (path - gate.start) * gate.bins_per_metre
    if k >= float(gate.bins) or path >= gate.stop:
        return AFTER
    return int(k)
