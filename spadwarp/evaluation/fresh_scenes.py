"""Histograms of scenes that nobody has seen: the judge of the network for histograms.

A scene follows from its seed and number: shapes, textures, instrument responses and backgrounds from families that no
training uses. Every other scene is rendered by Monte Carlo transport: a solid before a wall or in open water. Seeds of
the clock give scenes on which nothing can have been chosen; the seed is told, so that anyone can repeat the judgement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, gaussian_filter1d
from scipy.special import ndtr

from spadwarp.frames.response import detector_response
from spadwarp.mesh import builtin_names, make_builtin
from spadwarp.scene import Scene
from spadwarp.transport import simulate
from spadwarp.values import range_from_time

RENDERED_PHOTONS = 4_000_000
"""Photons of a rendered scene, some seconds on two cores. With 2e5 the light beside a target was of single events."""

_Image = NDArray[np.float64]


class FreshScene(NamedTuple):
    """Counts of a scene and what is true of them."""

    counts: NDArray[np.int64]  # [H, W, T]
    background: NDArray[np.float64]  # expected counts of each bin, [T], or of each pixel's, [H, W, T]
    response: NDArray[np.float64]  # per bin, centred on its time zero, sum 1, [2 r + 1]
    clean: NDArray[np.float64]  # true range [m], NaN where there is only water, [H, W]
    gate: tuple[float, float]  # [m]
    text: str  # families, size, photons and signal-to-background ratio


def fresh_scene(seed: int, number: int, *, device: str | None = None) -> FreshScene:
    """Scene `number` of a seed; every other one is rendered, on the Warp device `device`."""
    random = np.random.default_rng((seed, number))
    photons, sbr = float(np.exp(random.uniform(0.0, np.log(100.0)))), float(np.exp(random.uniform(*np.log([0.1, 5.0]))))
    rate, background, response, clean, gate, names = _rendered(random, device) if number % 2 else _drawn(random)
    seen = np.isfinite(clean)
    rate *= photons / max(float(np.median(rate.sum(axis=-1)[seen])), 1e-12)
    background = background * (photons / sbr / background.reshape(-1, background.shape[-1]).sum(axis=-1).mean()) + 1e-6
    size = " x ".join(map(str, rate.shape))
    return FreshScene(
        random.poisson(rate + background), background, response, clean, gate,
        f"{names}; {size}; {photons:.3g} photons, SBR {sbr:.2g}",
    )  # fmt: skip


_Light = tuple[_Image, _Image, _Image, _Image, tuple[float, float], str]
"""Signal `[H, W, T]`, background `[T]` or `[H, W, T]` in any unit; response, true range, gate and names."""


def _drawn(random: np.random.Generator) -> _Light:
    height, width, bins = random.integers(40, 81), random.integers(40, 81), random.integers(64, 401)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    families: Any = SHAPES, TEXTURES, RESPONSES, BACKGROUNDS
    shape, texture, pulse, water = (list(family)[random.integers(len(family))] for family in families)
    depth = SHAPES[shape](y, x, random)
    if random.random() < 0.5:  # a wall behind
        slope = random.uniform(-0.15, 0.15, 2)
        depth = np.fmin(depth, 1.0 + slope[0] * (y / height - 0.5) + slope[1] * (x / width - 0.5))
    if not np.isfinite(depth).any():
        depth = np.ones_like(depth)
    first = random.uniform(0.1, 0.6)
    low, high = np.nanmin(depth), np.nanmax(depth)
    place = first + (depth - low) / max(high - low, 0.2) * random.uniform(0.05, 0.93 - first)
    bright = TEXTURES[texture](y, x, random)
    taps = RESPONSES[pulse](random)
    radius = taps.size // 2
    edges = np.arange(bins + 1.0) - np.where(np.isfinite(place), place, -1e3)[..., None] * bins
    rate = np.diff(ndtr(edges / 0.3), axis=-1)  # narrow, then the response
    rate = convolve1d(rate, taps, axis=-1, mode="constant", origin=0) * bright[..., None]
    gate = float(random.uniform(1.0, 10.0)), 0.0
    gate = gate[0], gate[0] + bins * float(np.exp(random.uniform(*np.log([0.004, 0.02]))))
    background = BACKGROUNDS[water]((np.arange(bins) + 0.5) / bins, random)
    if water == "ambient":
        background = background * (bright / bright.mean())[..., None]
    narrow = np.diff(ndtr((np.arange(-radius - 1, radius + 1) + 0.5) / 0.3))
    response = np.convolve(taps, narrow, mode="same")
    clean = gate[0] + (gate[1] - gate[0]) * place
    return rate, background, response / response.sum(), clean, gate, f"{shape}, {texture}, {pulse}, {water}"


# Shapes: depth in any unit at pixels y, x, NaN beside them.


def _mosaic(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """Voronoi cells, each a tilted plane, some of them open."""
    count = random.integers(4, 30)
    at = random.uniform(0, 1, (count, 2)) * y.shape
    cell = np.argmin(np.hypot(y[..., None] - at[:, 0], x[..., None] - at[:, 1]), axis=-1)
    own, slope = random.uniform(0, 1, count), random.normal(0, 0.005, (2, count))
    own[random.random(count) < 0.2] = np.nan
    return own[cell] + slope[0, cell] * (y - at[cell, 0]) + slope[1, cell] * (x - at[cell, 1])


def _skyline(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """Rectangles that stand on the lower edge, or hang from the upper one."""
    depth = np.full(y.shape, np.nan)
    for _ in range(random.integers(3, 12)):
        left, wide, tall = random.uniform(-5, x.max()), random.uniform(2, 25), random.uniform(0.1, 0.9) * len(y)
        inside = (x >= left) & (x < left + wide) & ((y > len(y) - tall) if random.random() < 0.7 else (y < tall))
        depth = np.where(inside, np.fmin(depth, random.uniform(0, 0.9)), depth)
    return depth


def _wires(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """Straight wires one to three pixels wide, and a plate."""
    depth = np.where(np.hypot(y - y.mean(), x - x.mean()) < 0.3 * len(y), 0.8, np.nan)
    for _ in range(random.integers(2, 9)):
        angle, own = random.uniform(0, np.pi), random.uniform(0, 0.6)
        across = (y - random.uniform(0, y.max())) * np.cos(angle) + (x - random.uniform(0, x.max())) * np.sin(angle)
        depth = np.where(np.abs(across) < random.uniform(0.5, 1.6), np.fmin(depth, own), depth)
    return depth


def _craters(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """A slope with bowls that have raised rims; its far side open."""
    depth = 0.4 + random.uniform(-0.006, 0.006) * x + random.uniform(-0.006, 0.006) * y
    for _ in range(random.integers(3, 10)):
        radius = random.uniform(3, 18)
        far = np.hypot(y - random.uniform(0, y.max()), x - random.uniform(0, x.max())) / radius
        depth = depth + np.where(far < 1, 0.15 * (1 - far**2) - 0.05, -0.05 * np.exp(-4 * (far - 1)))
    return np.where(x + y * random.uniform(-1, 1) > 1.3 * x.max(), np.nan, depth)


def _gears(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """Toothed wheels with a hole, behind each other."""
    depth = np.full(y.shape, np.nan)
    for _ in range(random.integers(1, 5)):
        rows, columns = y - random.uniform(0, y.max()), x - random.uniform(0, x.max())
        radius, teeth = random.uniform(8, 28), random.integers(5, 16)
        far, angle = np.hypot(rows, columns), np.arctan2(rows, columns)
        rim = radius * (1.0 + 0.15 * np.sign(np.sin(teeth * angle)))
        depth = np.where((far < rim) & (far > 0.3 * radius), np.fmin(depth, random.uniform(0, 0.9)), depth)
    return depth


def _code(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """Squares of two or three depths, as of a printed code."""
    side, levels = random.integers(3, 13), random.uniform(0, 1, 3)
    own = levels[random.integers(0, random.integers(2, 4), (40, 40))]
    return np.asarray(own[(y // side).astype(int), (x // side).astype(int)])


def _helix(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """A winding stair around an axis: depth by the angle, with one high jump."""
    angle = np.arctan2(y - random.uniform(0.3, 0.7) * len(y), x - random.uniform(0.3, 0.7) * x.max())
    steps = random.integers(6, 40)
    depth = np.floor((angle / (2 * np.pi) + 0.5) * steps) / steps
    return np.where(np.hypot(y - y.mean(), x - x.mean()) < random.uniform(0.35, 0.8) * len(y), depth, np.nan)


def _folds(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    """A folded sheet, with slits."""
    angle, pitch = random.uniform(0, np.pi), random.uniform(8, 40)
    along = (y * np.cos(angle) + x * np.sin(angle)) / pitch
    across = (x * np.cos(angle) - y * np.sin(angle)) / random.uniform(10, 40)
    fold = np.abs(2.0 * (along % 1.0) - 1.0)
    return np.where((across % 1.0 < 0.15) & (random.random() < 0.6), np.nan, random.uniform(0.1, 1.0) * fold)


SHAPES: dict[str, Callable[[_Image, _Image, np.random.Generator], _Image]] = {
    "mosaic": _mosaic, "skyline": _skyline, "wires": _wires, "craters": _craters, "gears": _gears, "code": _code,
    "helix": _helix, "folds": _folds,
}  # fmt: skip


# Brightness of pixels, instrument responses, and backgrounds over the gate.


def _cells(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    side = random.integers(2, 16)
    return np.exp(random.normal(0, 0.6, (80, 80)))[(y // side).astype(int), (x // side).astype(int)]


def _beam(y: _Image, x: _Image, random: np.random.Generator) -> _Image:
    square = ((y - y.mean()) / len(y)) ** 2 + ((x - x.mean()) / x.max()) ** 2
    return np.exp(-random.uniform(0.5, 6.0) * square)


TEXTURES: dict[str, Callable[[_Image, _Image, np.random.Generator], _Image]] = {
    "even": lambda y, x, random: np.ones_like(y),
    "patches": _cells,
    "beam": _beam,
    "speckle": lambda y, x, random: random.gamma(random.uniform(2, 20), size=y.shape) + 0.05,
}


def _taps(shape: Callable[[_Image], _Image], radius: int) -> _Image:
    """A response over 2 × `radius` + 1 bins, its mean in the middle."""
    place = np.arange(-radius, radius + 1.0)
    values = shape(place)
    middle = (values * place).sum() / values.sum()
    values = shape(place + middle)
    return np.asarray(values / values.sum())


def _late(random: np.random.Generator) -> _Image:
    width, tail = random.uniform(0.6, 2.0), random.uniform(1.0, 4.0)
    return _taps(lambda t: ndtr(t / width - width / tail) * np.exp(-np.maximum(t, -20.0) / tail), 24)


def _double(random: np.random.Generator) -> _Image:
    width, apart, part = random.uniform(0.5, 1.2), random.uniform(2.5, 7.0), random.uniform(0.1, 0.5)
    return _taps(lambda t: np.exp(-0.5 * (t / width) ** 2) + part * np.exp(-0.5 * ((t - apart) / width) ** 2), 16)


def _sech(random: np.random.Generator) -> _Image:
    width = random.uniform(0.6, 3.0)
    return _taps(lambda t: 1.0 / np.cosh(t / width) ** 2, 16)


RESPONSES: dict[str, Callable[[np.random.Generator], _Image]] = {
    "late tail": _late,
    "two pulses": _double,
    "box": lambda random: gaussian_filter1d(
        np.repeat([0.0, 1.0, 0.0], [9, 2 * int(random.integers(1, 4)) + 1, 9]), 0.7
    ),
    "sech": _sech,
}

BACKGROUNDS: dict[str, Callable[[_Image, np.random.Generator], _Image]] = {
    "flat": lambda t, random: np.ones_like(t),
    "ambient": lambda t, random: np.ones_like(t),
    "1/z²": lambda t, random: np.exp(-random.uniform(0, 4) * t) / (t + random.uniform(0.1, 0.5)) ** 2,
    "two waters": lambda t, random: np.exp(-random.uniform(4, 12) * t) + random.uniform(0.02, 0.4) * np.exp(-t),
    "gated": lambda t, random: ndtr((t - random.uniform(0.0, 0.3)) / 0.05) * np.exp(-random.uniform(0, 5) * t) + 0.05,
}


# Rendered by transport.


def _rendered(random: np.random.Generator, device: str | None) -> _Light:
    distance, bins = random.uniform(2.0, 6.0), int(random.integers(64, 257))
    solid = str(random.choice(builtin_names()))
    targets: list[dict[str, Any]] = [
        {"builtin": solid, "rotation_deg": [float(one) for one in random.uniform(-40, 40, 3)], "reflectance": 0.4}
    ]
    scene = Scene.from_dict(
        {
            "medium": {"absorption": random.uniform(0.05, 0.3), "scattering": random.uniform(0.05, 0.6)},
            "laser": {"half_angle_deg": 14.0, "pulse_fwhm_ps": random.uniform(100.0, 400.0)},
            "camera": {
                "width": int(random.integers(32, 65)), "height": int(random.integers(32, 65)),
                "horizontal_fov_deg": 18.0, "aperture_diameter": 0.02,
            },
            "gate": {"start_ns": 1.0, "bin_width_ps": 100.0, "bins": bins},
            "transport": {"estimator": "guided"},
        }
    )  # fmt: skip
    index = scene.medium.group_index
    start = distance - random.uniform(0.5, 1.5)
    width = random.uniform(2.0, 3.5) / bins  # of a bin in range [m]
    size = 0.25 * distance * random.uniform(0.5, 1.0)  # [m], of what the camera sees about 0.32 times the distance
    extent = float(np.ptp(make_builtin(solid).vertices, axis=0).max())
    targets[0] |= {"scale": size / extent, "translation": [0.0, 0.0, distance]}
    if wall := bool(random.random() < 0.5):
        tilt = [float(one) for one in random.uniform(-15, 15, 2)]
        targets.append(
            {"builtin": "plane", "size": 4.0, "rotation_deg": [*tilt, 0.0], "translation": [0.0, 0.0, distance + 0.6]}
        )
    step = 1e12 * width / range_from_time(1.0, index)
    scene = scene.with_overrides(
        gate={"start_ns": 1e9 * start / range_from_time(1.0, index), "bin_width_ps": step}, targets=targets
    )
    result = simulate(scene, photons=RENDERED_PHOTONS, seed=int(random.integers(2**32)), device=device)
    response = detector_response(scene.detector, scene.laser).per_bin(scene.gate.bin_width)
    signal = result.component("ballistic") + result.component("forward_scattered")
    signal = convolve1d(np.asarray(signal, np.float64), response, axis=-1, mode="constant")
    back = np.asarray(result.component("backscatter"), np.float64).sum(axis=(0, 1))
    back = np.maximum(gaussian_filter1d(np.convolve(back, response, mode="same"), 3.0), 0.0)
    gate = start, start + bins * width
    clean = np.asarray(result.truth.range, np.float64)
    clean = np.where((clean < gate[1]) & (clean >= gate[0]) & (signal.sum(axis=-1) > 0), clean, np.nan)
    return signal, back, response, clean, gate, f"rendered {solid}{' before a wall' * wall}"
