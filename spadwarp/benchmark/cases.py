"""Named benchmark cases: scenes as tables, or a stage that is given artificial light. No other file is read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from spadwarp.values import path_from_time, time_from_path

__all__ = ["CASES", "GROUPS", "Case"]


@dataclass(frozen=True)
class Case:
    """One thing to measure.

    Attributes:
        name: Its key.
        summary: What it is, in one line.
        kind: "transport", "analytic" or "detect".
        scene: Tables of a scene, as `Scene.from_dict` takes them.
        estimator: Replaces the scene's estimator: "none" traces photons without a camera.
        photons: Of one run; None: chosen for the device.
        absorbed: Known absorbed fraction of the light, and half its last digit.
        error: Whether to use a run for the relative error.
        time_limit: Seconds of timed runs after which none is repeated.
    """

    name: str
    summary: str
    kind: str = "transport"
    scene: Mapping[str, Any] = field(default_factory=dict)
    estimator: str | None = None
    photons: int | None = None
    absorbed: tuple[float, float] | None = None
    error: bool = True
    time_limit: float = math.inf


_WATER = {"extinction": 0.3, "albedo": 0.8, "anisotropy": 0.924, "group_index": "seawater"}


def _staircase(subdivisions: int = 0) -> list[dict[str, Any]]:
    """A plate of 4 x 4 m, its face at 5 m, and nine bars 0.1 to 0.6 m in front of it: ten boxes, 120 faces."""
    boxes = [((-2.0, -2.0), (2.0, 2.0), -0.1)]  # two corners, and the height above the plate
    for i in range(3):
        boxes += [
            ((-2.0 + 0.67 * i, -2.0), (-1.37 + 0.67 * i, 2.0), 0.6 - 0.1 * i),
            ((0.0, -2.0 + 0.7 * i), (2.0, -1.4 + 0.7 * i), 0.3 - 0.1 * i),
            ((0.67 * i, 0.0), (0.63 + 0.67 * i, 2.0), 0.3 - 0.1 * i),
        ]
    return [
        {
            "builtin": "box",
            "size": [right - left, bottom - top, abs(height)],
            "subdivisions": subdivisions,
            "translation": [0.5 * (left + right), 0.5 * (top + bottom), 5.0 - 0.5 * height],
            "reflectance": 0.5,
        }
        for (left, top), (right, bottom), height in boxes
    ]


def _at_5m(targets: Sequence[Mapping[str, Any]] = (), estimator: str = "next_event", **camera: Any) -> dict[str, Any]:
    """A cone of 15° beside a camera of 30° in turbid water; bins of 2 cm of path."""
    bins = camera.pop("bins", 1024)
    return {
        "medium": _WATER,
        "laser": {"half_angle_deg": 15.0, "position": [-0.05, 0.0, 0.0]},
        "camera": {"width": 64, "height": 64, "horizontal_fov_deg": 30.0, "aperture_diameter": 0.02, **camera},
        "gate": {"bin_width_ps": 90.983, "bins": bins},
        "targets": list(targets),
        "transport": {"estimator": estimator, "max_collisions": 64, "weight_cutoff": 2e-4},
    }


def _confocal() -> dict[str, Any]:
    """A coaxial beam of 0.1° that visits the 64 x 64 pixels of the staircase in turn."""
    scene = _at_5m(_staircase(), "guided")
    transport = {**scene["transport"], "axis_threshold": 1.0}
    return {**scene, "laser": {"half_angle_deg": 0.1}, "scan": {"mode": "confocal"}, "transport": transport}


def _plane() -> dict[str, Any]:
    """A grey wall at 5 m in index 1, 16 bins of 0.8 m of path from 2 m on."""
    start, width, diameter = time_from_path(2.0, 1.0), time_from_path(0.8, 1.0), 2.0 * math.sqrt(1e-4 / math.pi)
    return {
        "medium": {**_WATER, "group_index": 1.0, "phase_index": 1.0},
        "laser": {"half_angle_deg": 2.5, "position": [-0.1, 0.0, 0.0]},
        "camera": {"width": 32, "height": 32, "horizontal_fov_deg": 10.0, "aperture_diameter": diameter},
        "gate": {"start_ns": start * 1e9, "bin_width_ps": width * 1e12, "bins": 16},
        "targets": [{"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}],
        "transport": {"estimator": "guided", "max_collisions": 20, "weight_cutoff": 2e-4, "axis_threshold": 1.0},
    }


def _spheres() -> list[dict[str, Any]]:
    """Four by three spheres of 81 920 faces each."""
    sphere = {"builtin": "sphere", "size": 0.75, "subdivisions": 3, "reflectance": 0.5}
    return [{**sphere, "translation": [0.9 * (i - 1.5), 0.9 * (j - 1.0), 5.0]} for j in range(3) for i in range(4)]


def _cube60() -> dict[str, Any]:
    """MCX's benchmark of that name: a scattering cube of 60 mm without reflections, a pencil beam, 5 ns."""
    return {
        "medium": {"absorption": 5.0, "scattering": 1000.0, "anisotropy": 0.01, "group_index": 1.37},
        "laser": {"profile": "collimated", "beam_radius": 0.0, "position": [0.029, 0.029, 0.0]},
        "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01},  # not used
        "gate": {"bin_width_ps": 5000.0, "bins": 1},
        "domain": {"shape": "box", "lower": 0.0, "upper": 0.06},
        "transport": {
            "max_path": path_from_time(5e-9, 1.37),
            "weight_cutoff": 0.0,
            "max_collisions": 2**31 - 1,
            "axis_threshold": 1.0,
        },
    }


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("water", "41 m of water alone, next_event, 64 x 64 x 2048 bins", scene=_at_5m(bins=2048)),
        Case("water_20m", "20 m of water alone, 64 x 64 x 1024 bins", scene=_at_5m()),
        Case("plane_5m", "a wall at 5 m, guided, 32 x 32 x 16 bins", scene=_plane()),
        Case("staircase_5m", "a staircase at 5 m, next_event, 64 x 64 x 1024 bins", scene=_at_5m(_staircase())),
        Case("staircase_5m_guided", "the same, guided", scene=_at_5m(_staircase(), "guided")),
        Case("confocal", "the staircase, guided, 64 x 64 positions scanned by beam and pixel", scene=_confocal()),
        Case("staircase_5m_dense", "the same, next_event, more than 100 000 faces", scene=_at_5m(_staircase(5))),
        Case("spheres", "twelve spheres, a million faces in all, next_event", scene=_at_5m(_spheres())),
        Case(
            "cube60",
            "MCX's cube60: 60 mm, 78 collisions a photon, no camera",
            scene=_cube60(),
            estimator="none",
            absorbed=(0.1769, 0.5e-4),  # as MCX prints it: 17.69 %
        ),
        Case(
            "analytic",
            "depth frames of 400 x 400 pixels from the analytic simulator",
            kind="analytic",
            scene=_at_5m(_staircase(), width=400, height=400),
        ),
        Case("detect", "first-photon counts of 1e6 pulses; a frame of 256 x 192 x 1024 bins on a GPU", kind="detect"),
    )
}
"""The cases by name."""


def _scaling(cuda: bool) -> list[Case]:
    """How cost and memory grow with photons, faces and bins; to larger sizes on a GPU than on a CPU."""
    box = {"builtin": "box", "size": [3.0, 3.0, 0.5], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}
    images = [(32, 32, 256), (64, 64, 1024), (128, 128, 1024), (256, 192, 1024), (256, 192, 4096)]
    cases = []
    for power in range(5, 11 if cuda else 8):
        text = f"staircase_5m, 1e{power} photons"
        cases.append(Case(f"photons_1e{power}", text, scene=_at_5m(_staircase()), photons=10**power))
    for n in (0, 2, 4, 6, 8):
        faces = 12 * 4**n
        cases.append(Case(f"faces_{faces}", f"a box of {faces} faces", scene=_at_5m([{**box, "subdivisions": n}])))
    for width, height, bins in images if cuda else images[:3]:
        scene = _at_5m(_staircase(), width=width, height=height, bins=bins)
        text = f"staircase_5m into {width} x {height} x {bins} bins"
        cases.append(Case(f"bins_{width}x{height}x{bins}", text, scene=scene))
    return [replace(case, error=False, time_limit=2.0) for case in cases]


GROUPS: dict[str, Callable[[bool], list[Case]]] = {"scaling": _scaling}
"""Names that stand for several cases, which depend on whether the device is a GPU."""
