"""Terminal states of photons."""

import warp as wp

from spadwarp_kernels.arguments import check_device, check_integer


@wp.struct
class Records:
    """Terminal states by photon; arrays of length 0 where they are not asked for.

    Attributes:
        position: Where the history ended [m].
        direction: Unit vector of its last flight.
        weight: Weight at the end.
        path: Geometric path [m].
        collisions: Events, surfaces included.
        reason: Ledger entry that took the rest of the weight.
        scores: Derivatives of the logarithm of what the history has met, [photons, derivatives]; empty without them.
    """

    position: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    weight: wp.array(dtype=float)
    path: wp.array(dtype=float)
    collisions: wp.array(dtype=int)
    reason: wp.array(dtype=int)
    scores: wp.array2d(dtype=float)


def make_records(count: int, *, device: wp.DeviceLike = None, derivatives: int = 0) -> Records:
    """Room for the terminal states of `count` photons, and so many scores each; raises `ArgumentError` for negative
    numbers."""
    count, derivatives = check_integer("count", count, 0), check_integer("derivatives", derivatives, 0)
    device = check_device("device", device)
    records = Records()
    records.position = wp.zeros(count, dtype=wp.vec3, device=device)
    records.direction = wp.zeros(count, dtype=wp.vec3, device=device)
    records.weight = wp.zeros(count, dtype=float, device=device)
    records.path = wp.zeros(count, dtype=float, device=device)
    records.collisions = wp.zeros(count, dtype=int, device=device)
    records.reason = wp.zeros(count, dtype=int, device=device)
    records.scores = wp.zeros((count, derivatives), dtype=float, device=device)
    return records
