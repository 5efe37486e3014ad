"""At how many points a flight is scored, and what that does not go with."""

from __future__ import annotations

from collections.abc import Sequence

from spadwarp.scene import Scene
from spadwarp.transport.grid_model import grid_tracking
from spadwarp.transport.placement import config_error

__all__ = ["points_per_flight"]


def points_per_flight(scene: Scene, kinds: Sequence[str] = (), by_block: Sequence[str] = ()) -> int:
    """Points at which a flight is scored, with these kinds of derivatives and those by block.

    Raises `ConfigError` for what does not go with several.
    """
    points = scene.transport.points_per_flight
    if points == 1:
        return points
    import spadwarp_kernels as sk

    estimator = scene.transport.estimator
    against = {
        f'estimator = "{estimator}"': estimator != "guided",
        "faces of the domain that reflect": bool(scene.domain.reflecting),
        "derivatives by block": bool(by_block),
        'medium.grid.tracking = "delta"': grid_tracking(scene) is sk.DELTA_TRACKING,
    }
    if any(against.values()):
        names = " and ".join(name for name, found in against.items() if found)
        raise config_error(scene, f"transport.points_per_flight = {points} does not go with {names}; take 1")
    if points > 2 and len(kinds) > 4:
        raise config_error(scene, f"transport.points_per_flight = {points} goes with up to 4 derivatives; take 2")
    return points
