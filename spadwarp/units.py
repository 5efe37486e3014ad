"""Physical constants, and the one place where the time of flight of a pulse becomes a length."""

from __future__ import annotations

from typing import Any

__all__ = [
    "PLANCK",
    "SPEED_OF_LIGHT",
    "path_from_time",
    "pulse_speed",
    "range_from_time",
    "time_from_path",
    "time_from_range",
]

SPEED_OF_LIGHT = 299_792_458.0
"""c0, in vacuum [m/s]."""

PLANCK = 6.626_070_15e-34
"""h [J s]."""


def pulse_speed(group_index: float) -> float:
    """Speed of a pulse in water, c0 over the group index [m/s]."""
    return SPEED_OF_LIGHT / group_index


def path_from_time(time: Any, group_index: float) -> Any:
    """Geometric path [m] of a time of flight [s], a number or an array; `time_from_path` is its inverse."""
    return time * pulse_speed(group_index)


def time_from_path(path: Any, group_index: float) -> Any:
    """Time of flight [s] along a geometric path [m], a number or an array."""
    return path * (group_index / SPEED_OF_LIGHT)


def range_from_time(time: Any, group_index: float) -> Any:
    """Range [m] of a round trip of a time [s], laser at the lens; `spadwarp.scene.geometry` has it for any laser."""
    return 0.5 * pulse_speed(group_index) * time


def time_from_range(distance: Any, group_index: float) -> Any:
    """Time [s] of a round trip to a range [m], laser at the lens."""
    return distance * (2.0 * group_index / SPEED_OF_LIGHT)
