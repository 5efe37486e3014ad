"""Procedural clean scenes for training, drawn on the training device.

Each scene has open water, a wall or a slanted floor, and up to ten things before it: plates, ellipsoids, rods, ropes,
nets, ladders, plants, chains, rocks and blocks, at depths of their own or close together as parts of one body, with a
texture of reflectance. The shapes of `spadwarp.denoise.evaluation_scenes` and the built-in meshes are not among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["KINDS", "Random", "draw_scenes", "smooth_noise"]

_THINGS = 10  # at most, in a scene
_JITTER = 0.004  # deviation of a reported depth [m]; a recipe's sigma_scale multiplies it


@dataclass(frozen=True, eq=False)
class Random:
    """Random numbers for `size` samples from one generator, in the order of the calls."""

    size: int
    generator: torch.Generator

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand((self.size, *shape), generator=self.generator, device=self.generator.device)

    def between(self, limits: tuple[float, float], *shape: int) -> Tensor:
        return limits[0] + (limits[1] - limits[0]) * self.uniform(*shape)

    def log_between(self, limits: tuple[float, float], *shape: int) -> Tensor:
        return torch.exp(math.log(limits[0]) + math.log(limits[1] / limits[0]) * self.uniform(*shape))

    def coin(self, probability: float, *shape: int) -> Tensor:
        return self.uniform(*shape) < probability

    def normal(self, shape: torch.Size) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.generator.device)

    def integer(self, stop: int, *shape: int) -> Tensor:
        return torch.randint(stop, (self.size, *shape), generator=self.generator, device=self.generator.device)


def draw_scenes(count: int, side: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Clean scenes on the generator's device.

    Args:
        count: Number of scenes.
        side: Rows and columns [pixels].
        generator: Of all random numbers.

    Returns:
        Depth `[S, side, side]` [m], NaN where there is only water; the deviation of reported depths of the same shape
        [m], NaN there too; and a gate around what is seen `[S, 2]` [m].
    """
    random = Random(count, generator)
    relief = random.log_between((0.08, 2.5), 1, 1)  # of the whole scene [m]
    depth = _background(side, random)
    together = random.coin(0.35)  # things that are parts of one body
    centre, place = 0.3 * side * (2 * random.uniform(2) - 1), random.between((0.15, 0.85))
    paint = 0.5 * random.normal(torch.Size((count, 1, 1))) * torch.ones_like(depth)  # ln of reflectance, negative
    number = torch.where(random.coin(0.15), 0, 1 + random.integer(_THINGS))
    for slot in range(_THINGS):
        apart = random.between((-0.6, 0.6), 2) * side
        at = torch.where(together[:, None], centre + 0.35 * apart, apart)
        z = torch.where(together, place + 0.15 * (random.uniform() - 0.5), random.between((0.0, 0.95)))
        kind = random.integer(len(KINDS))
        for index, draw in enumerate(KINDS.values()):
            chosen = ((kind == index) & (slot < number)).nonzero()[:, 0]
            if len(chosen):
                part = Random(len(chosen), generator)
                inside, surface = draw(*_turned(at[chosen], side, part), part)
                surface = z[chosen, None, None] + surface
                drawn = inside & (surface > -0.1) & ~(surface >= depth[chosen])
                depth[chosen] = torch.where(drawn, surface, depth[chosen])
                paint[chosen] = torch.where(drawn, 0.5 * part.normal(torch.Size((len(chosen), 1, 1))), paint[chosen])
    metres = 15.0 + relief * (depth - 0.5)
    texture = torch.exp(0.5 * smooth_noise(count, side, generator) + 0.3 * _pattern(side, random) + paint)
    sigma = torch.where(torch.isfinite(metres), _JITTER * texture.clamp(0.3, 4.0), math.nan)
    low = torch.where(torch.isfinite(metres), metres, math.inf).flatten(1).amin(dim=1)
    high = torch.where(torch.isfinite(metres), metres, -math.inf).flatten(1).amax(dim=1)
    empty = low > high
    low, high = torch.where(empty, 14.5, low), torch.where(empty, 15.5, high)
    margins = random.log_between((0.02, 2.0), 2)
    return metres, sigma, torch.stack([low - margins[:, 0], high + margins[:, 1]], dim=1)


def smooth_noise(count: int, side: int, generator: torch.Generator) -> Tensor:
    """Fields of noise over several scales, deviation about 1, `[count, side, side]`."""
    total = torch.zeros((count, 1, side, side), device=generator.device)
    random = Random(count, generator)
    for cells in (3, 6, 12, 24):
        coarse = random.normal(torch.Size((count, 1, cells, cells)))
        weight = random.uniform(1, 1, 1) * (3.0 / cells) ** 0.5
        total += weight * F.interpolate(coarse, size=(side, side), mode="bicubic", align_corners=False)
    return total[:, 0]


def _background(side: int, random: Random) -> Tensor:
    """Relative depth of what is behind: NaN (water), a wall about 1, or a floor that comes near at one side."""
    count, device = random.size, random.generator.device
    y, x = _turned(torch.zeros(count, 2, device=device), side, random)
    kind = random.uniform()[:, None, None]
    rough = 0.15 * random.uniform(1, 1) * random.coin(0.6, 1, 1) * smooth_noise(count, side, random.generator)
    slope = 0.6 * (2 * random.uniform(1, 1) - 1) * random.coin(0.7, 1, 1)
    wall = 1.0 + slope * x / side + rough
    nearest, horizon = random.between((0.0, 0.7), 1, 1), random.between((-0.6, 0.5), 1, 1)
    below = (y / side - horizon).clamp_min(0.0) / (1.2 - horizon)
    floor = nearest + (1.2 - nearest) / (1.0 + 5.0 * below) + 0.3 * rough
    floor = torch.where(below > 0.0, floor, math.nan)
    return torch.where(kind < 0.42, torch.full_like(wall, math.nan), torch.where(kind < 0.75, wall, floor))


def _turned(at: Tensor, side: int, random: Random) -> tuple[Tensor, Tensor]:
    """Image coordinates about `at`, turned by a random angle, `[S, side, side]` [pixels]."""
    line = torch.arange(side, device=at.device) - 0.5 * (side - 1)
    y, x = line[None, :, None] - at[:, 0, None, None], line[None, None, :] - at[:, 1, None, None]
    angle = 2 * math.pi * random.uniform(1, 1)
    return y * angle.cos() + x * angle.sin(), x * angle.cos() - y * angle.sin()


def _pattern(side: int, random: Random) -> Tensor:
    """Stripes or squares of reflectance, ±1, or nothing, `[S, side, side]`."""
    y, x = _turned(torch.zeros(random.size, 2, device=random.generator.device), side, random)
    pitch = random.log_between((3.0, 40.0), 1, 1)
    stripes = torch.sign(torch.sin(x / pitch * math.pi))
    squares = stripes * torch.sign(torch.sin(y / pitch * math.pi))
    kind = random.uniform(1, 1)
    return torch.where(kind < 0.5, 0.0, torch.where(kind < 0.75, stripes, squares))


# Shapes: where they are, and their relative depth about their own, at coordinates y, x [pixels] `[S, side, side]`.


def _plate(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A slanted polygon of three to six sides."""
    inside = torch.ones_like(x, dtype=torch.bool)
    sides, first = 3 + random.integer(4, 1, 1), 2 * math.pi * random.uniform(1, 1)
    size = random.log_between((4.0, 70.0), 1, 1)
    for side in range(6):
        angle = first + 2 * math.pi * (side + 0.5 * random.uniform(1, 1)) / sides
        reach = size * random.between((0.4, 1.0), 1, 1)
        inside &= (x * angle.cos() + y * angle.sin() < reach) | (sides <= side)
    return inside, (random.between((-0.4, 0.4), 1, 1) * x + random.between((-0.4, 0.4), 1, 1) * y) / 100.0


def _ellipsoid(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    long = random.log_between((3.0, 70.0), 1, 1)
    square = (x / long).square() + (y / (long * random.between((0.25, 1.0), 1, 1))).square()
    return square < 1.0, -random.between((0.0, 0.4), 1, 1) * (1.0 - square).clamp_min(0.0).sqrt()


def _rod(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    half, length = random.log_between((0.5, 14.0), 1, 1), random.log_between((8.0, 120.0), 1, 1)
    taper = 1.0 - random.uniform(1, 1) * random.coin(0.4, 1, 1) * (0.5 + 0.5 * x / length).clamp(0.0, 1.0)
    width = half * taper
    inside = (y.abs() < width) & (x.abs() < length)
    bulge = random.uniform(1, 1) * 0.006 * (width.square() - y.square()).clamp_min(0.0).sqrt()
    return inside, random.between((-0.5, 0.5), 1, 1) * x / 120.0 - bulge


def _rope(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    wave = random.between((0.0, 20.0), 1, 1) * torch.sin(
        x / random.between((6.0, 40.0), 1, 1) + 6 * random.uniform(1, 1)
    )
    curve = wave + random.between((-0.004, 0.004), 1, 1) * x.square()
    slope = torch.gradient(curve, dim=2)[0].clamp(-3.0, 3.0)
    half = random.log_between((0.5, 3.0), 1, 1) * (1.0 + slope.square()).sqrt()
    return (y - curve).abs() < half, random.between((-0.4, 0.4), 1, 1) * x / 120.0


def _net(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    pitch, half = random.log_between((5.0, 36.0), 1, 1), random.log_between((0.5, 2.2), 1, 1)
    second = torch.where(random.coin(0.5, 1, 1), 1.0, random.between((0.4, 2.5), 1, 1)) * pitch
    bent = y + 3.0 * torch.sin(x / 17.0 + 6 * random.uniform(1, 1)) * random.coin(0.5, 1, 1)
    lines = ((x / pitch - (x / pitch).round()).abs() * pitch < half) | (
        (bent / second - (bent / second).round()).abs() * second < half
    )
    extent = random.log_between((20.0, 120.0), 2, 1, 1)
    inside = (x.abs() < extent[:, 0]) & (y.abs() < extent[:, 1])
    return lines & inside, random.between((-0.4, 0.4), 1, 1) * x / 120.0 + 0.03 * torch.sin(y / 23.0)


def _ladder(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    half, apart, pitch = (random.log_between(limits, 1, 1) for limits in ((0.6, 4.0), (6.0, 30.0), (6.0, 24.0)))
    rails = (y.abs() - apart).abs() < half
    rungs = ((x / pitch - (x / pitch).round()).abs() * pitch < 0.8 * half) & (y.abs() < apart)
    return (rails | rungs) & (x.abs() < random.between((30.0, 110.0), 1, 1)), random.between(
        (-0.5, 0.5), 1, 1
    ) * x / 120.0


def _plant(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """Leaves that sway, each at a depth of its own."""
    inside, depth = torch.zeros_like(x, dtype=torch.bool), torch.zeros_like(x)
    for _ in range(5):
        foot, length = random.between((-25.0, 25.0), 1, 1), random.between((15.0, 80.0), 1, 1)
        bend = random.between((2.0, 14.0), 1, 1) * torch.sin(
            y / random.between((8.0, 30.0), 1, 1) + 6 * random.uniform(1, 1)
        )
        width = random.log_between((0.6, 5.0), 1, 1) * (1.0 - y.abs() / length).clamp_min(0.0)
        leaf = (x - foot - bend).abs() < width
        depth = torch.where(leaf, random.between((-0.15, 0.15), 1, 1) + 0.002 * y, depth)
        inside |= leaf
    return inside, depth


def _chain(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    pitch = random.log_between((8.0, 26.0), 1, 1)
    along = x / pitch - (x / pitch).round()
    radius = ((along * 1.7).square() + (y / (0.5 * pitch)).square()).sqrt()
    link = (radius - 0.75).abs() < random.between((0.12, 0.3), 1, 1)
    return link & (x.abs() < random.between((30.0, 120.0), 1, 1)), random.between((-0.4, 0.4), 1, 1) * x / 120.0


def _rock(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A patch of thresholded noise, whose relief is the noise."""
    noise = smooth_noise(random.size, x.shape[-1], random.generator)
    fade = (x.square() + y.square()).sqrt() / random.log_between((15.0, 80.0), 1, 1)
    height = noise + 1.0 - 1.5 * fade
    return height > 0.0, -random.between((0.0, 0.25), 1, 1) * height.clamp(0.0, 2.0)


def _blocks(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A field of rectangular blocks of random heights."""
    pitch = random.log_between((5.0, 30.0), 2, 1, 1)
    row, column = (y / pitch[:, 0]).floor(), (x / pitch[:, 1]).floor()
    hashed = torch.sin(12.9898 * row + 78.233 * column + 100.0 * random.uniform(1, 1)) * 43758.5453
    height = hashed - hashed.floor()
    extent = random.log_between((10.0, 80.0), 2, 1, 1)
    inside = (x.abs() < extent[:, 0]) & (y.abs() < extent[:, 1]) & (height > random.between((-0.5, 0.5), 1, 1))
    return inside, -random.between((0.02, 0.5), 1, 1) * height


KINDS: dict[str, Callable[[Tensor, Tensor, Random], tuple[Tensor, Tensor]]] = {
    "plate": _plate,
    "ellipsoid": _ellipsoid,
    "rod": _rod,
    "rope": _rope,
    "net": _net,
    "ladder": _ladder,
    "plant": _plant,
    "chain": _chain,
    "rock": _rock,
    "blocks": _blocks,
}
"""Things in the scenes, by name."""
