"""Training pairs drawn on the training device: clean scenes, crops of them, and what a SPAD camera reports of these.

Each scene has open water, a wall or a slanted floor, and up to ten things before it: plates, ellipsoids, rods, ropes,
nets, ladders, plants, chains, rocks, blocks, slabs, sieves and waves, at depths of their own or close together as parts
of one body, with a texture of reflectance. The shapes of `spadwarp.evaluation` and the built-in meshes are not among
them.

A noisy frame is never stored. Each step draws crops, gates, waters and photons anew, so no two frames of a training are
alike. Depth is over the gate: 0 at its start, 1 at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.classical import deviation, highest, interpolated, toeplitz
from spadwarp.denoise.frames import LOG_DENSITY_LIMIT, MARGIN
from spadwarp.denoise.histogram_network import halved, rebinned
from spadwarp.denoise.recipe import Noise

_THINGS = 10  # at most, in a scene
_JITTER = 0.004  # deviation of a reported depth [m]; a recipe's sigma_scale multiplies it

BINS = 64
"""Bins of a backscatter profile over the gate."""

SUBPIXELS = 3
"""Rows and columns of subpixels in each pixel of the scenes behind histograms: a pixel sees an area, not a point."""


class CleanScenes(NamedTuple):
    """Clean scenes on the training device, float32; H and W of pixels, or of subpixels."""

    depth: Tensor  # [S, H, W] [m]; NaN where nothing is hit
    sigma: Tensor  # Cramér–Rao bound of depth, [S, H, W] [m]; NaN where there is none
    gate: Tensor  # start and stop in depth, [S, 2] [m]
    profile: Tensor  # density of backscatter over the gate, mean 1, [S, BINS]

    def to(self, device: torch.device | str) -> CleanScenes:
        """The same on another device."""
        return CleanScenes(*(values.to(device) for values in self))


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

    def normal(self, *shape: int) -> Tensor:
        return torch.randn((self.size, *shape), generator=self.generator, device=self.generator.device)

    def integer(self, stop: int, *shape: int) -> Tensor:
        return torch.randint(stop, (self.size, *shape), generator=self.generator, device=self.generator.device)


def procedural_scenes(count: int, side: int, *, seed: int, device: torch.device | str, finer: int = 1) -> CleanScenes:
    """Scenes in water of flat backscatter, with gates around them.

    With `finer` they are of so many rows and columns of subpixels in each pixel, in part from farther away, steep
    surfaces are darker, and some scenes are evenly bright but for that.
    """
    generator = torch.Generator(device).manual_seed(seed)
    random = Random(count, generator)
    relief = random.log_between((0.08, 2.5), 1, 1)  # of the whole scene [m]
    depth = _background(side, random, finer)
    together = random.coin(0.35)  # things that are parts of one body
    centre, place = 0.3 * side * (2 * random.uniform(2) - 1), random.between((0.15, 0.85))
    paint = 0.5 * random.normal(1, 1) * torch.ones_like(depth)  # ln of reflectance, negative
    number = torch.where(random.coin(0.15), 0, 1 + random.integer(_THINGS))
    far = torch.ones_like(place)  # as much smaller are all things
    if finer > 1:
        far = torch.where(random.coin(0.4), far, random.log_between((1.0, 4.0)))
    for slot in range(_THINGS):
        apart = random.between((-0.6, 0.6), 2) * side
        at = torch.where(together[:, None], centre + 0.35 * apart, apart)
        z = torch.where(together, place + 0.15 * (random.uniform() - 0.5), random.between((0.0, 0.95)))
        kind = random.integer(len(KINDS))
        for index, draw in enumerate(KINDS):
            chosen = ((kind == index) & (slot < number)).nonzero()[:, 0]
            if len(chosen):
                part = Random(len(chosen), generator)
                y, x = _turned(at[chosen], side, part, finer)
                inside, surface = draw(far[chosen, None, None] * y, far[chosen, None, None] * x, part)
                surface = z[chosen, None, None] + surface
                drawn = inside & (surface > -0.1) & ~(surface >= depth[chosen])
                depth[chosen] = torch.where(drawn, surface, depth[chosen])
                paint[chosen] = torch.where(drawn, 0.5 * part.normal(1, 1), paint[chosen])
    metres = 15.0 + relief * (depth - 0.5)
    grain = 0.5 * random.uniform(1, 1) * random.coin(0.3, 1, 1) * random.normal(*depth.shape[1:])  # from pixel to pixel
    texture = 0.5 * smooth_noise(random, side * finer) + 0.3 * _pattern(side, random, finer) + (paint + grain)
    if finer > 1:
        texture *= 1.0 - (2.0 * random.uniform(1, 1)).clamp_max(1.0) * random.coin(0.4, 1, 1)
    texture = texture.exp()
    if finer > 1:
        texture *= _steepness(metres * finer / random.log_between((0.01, 0.12), 1, 1)).square().add(1.0) ** 0.25
    sigma = torch.where(torch.isfinite(metres), _JITTER * texture.clamp(0.3, 4.0), math.nan)
    low, high = _extent(metres, metres.isfinite(), metres.new_tensor([[14.5, 15.5]]))
    margins = random.log_between((0.02, 2.0), 2)
    gate = torch.stack([low - margins[:, 0], high + margins[:, 1]], dim=1)
    return CleanScenes(metres, sigma, gate, torch.ones(count, BINS, device=metres.device))


def smooth_noise(random: Random, side: int) -> Tensor:
    """Fields of noise over several scales, deviation about 1, `[S, side, side]`."""
    total = torch.zeros((random.size, 1, side, side), device=random.generator.device)
    for cells in (3, 6, 12, 24):
        coarse = random.normal(1, cells, cells)
        weight = random.uniform(1, 1, 1) * (3.0 / cells) ** 0.5
        total += weight * F.interpolate(coarse, size=(side, side), mode="bicubic", align_corners=False)
    return total[:, 0]


def _steepness(depth: Tensor) -> Tensor:
    """Slope of a map `[S, h, w]` from one to the next, on the side where it is less; 0 beside open water."""
    total = torch.zeros_like(depth)
    for axis in (1, 2):
        step = depth.diff(dim=axis).abs()
        ends = step.narrow(axis, 0, 1), step.narrow(axis, -1, 1)
        before, after = torch.cat([ends[0], step], axis), torch.cat([step, ends[1]], axis)
        total += torch.fmin(before, after).nan_to_num(0.0).square()
    return total.sqrt()


def _background(side: int, random: Random, finer: int) -> Tensor:
    """Relative depth of what is behind: NaN (water), a wall about 1, or a floor that comes near at one side."""
    y, x = _turned(torch.zeros(random.size, 2, device=random.generator.device), side, random, finer)
    kind = random.uniform()[:, None, None]
    rough = 0.15 * random.uniform(1, 1) * random.coin(0.6, 1, 1) * smooth_noise(random, side * finer)
    slope = 0.6 * (2 * random.uniform(1, 1) - 1) * random.coin(0.7, 1, 1)
    wall = 1.0 + slope * x / side + rough
    nearest, horizon = random.between((0.0, 0.7), 1, 1), random.between((-0.6, 0.5), 1, 1)
    below = (y / side - horizon).clamp_min(0.0) / (1.2 - horizon)
    floor = nearest + (1.2 - nearest) / (1.0 + 5.0 * below) + 0.3 * rough
    floor = torch.where(below > 0.0, floor, math.nan)
    return torch.where(kind < 0.42, torch.full_like(wall, math.nan), torch.where(kind < 0.75, wall, floor))


def _turned(at: Tensor, side: int, random: Random, finer: int) -> tuple[Tensor, Tensor]:
    """Image coordinates about `at`, turned by a random angle, often a right one, `[S, side, side]` [pixels]."""
    line = (torch.arange(side * finer, device=at.device) - 0.5 * (side * finer - 1)) / finer
    y, x = line[None, :, None] - at[:, 0, None, None], line[None, None, :] - at[:, 1, None, None]
    angle = 2 * math.pi * random.uniform(1, 1)
    right = torch.round(angle * (2 / math.pi)) * (math.pi / 2)
    angle = torch.where(random.coin(0.35, 1, 1), right, angle)
    return y * angle.cos() + x * angle.sin(), x * angle.cos() - y * angle.sin()


def _pattern(side: int, random: Random, finer: int) -> Tensor:
    """Stripes or squares of reflectance, ±1, or nothing, `[S, side, side]`."""
    y, x = _turned(torch.zeros(random.size, 2, device=random.generator.device), side, random, finer)
    pitch = random.log_between((3.0, 40.0), 1, 1)
    stripes = torch.sign(torch.sin(x / pitch * math.pi))
    squares = stripes * torch.sign(torch.sin(y / pitch * math.pi))
    kind = random.uniform(1, 1)
    return torch.where(kind < 0.5, 0.0, torch.where(kind < 0.75, stripes, squares))


# Shapes: where they are, and their relative depth about their own, at coordinates y, x [pixels] `[S, side, side]`.


def _within(y: Tensor, x: Tensor, limits: tuple[float, float], random: Random) -> Tensor:
    """A rectangle."""
    extent = random.log_between(limits, 2, 1, 1)
    return (x.abs() < extent[:, 0]) & (y.abs() < extent[:, 1])


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


def _wave(along: Tensor, heights: tuple[float, float], lengths: tuple[float, float], random: Random) -> Tensor:
    return random.between(heights, 1, 1) * torch.sin(along / random.between(lengths, 1, 1) + 6 * random.uniform(1, 1))


def _rope(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    curve = _wave(x, (0.0, 20.0), (6.0, 40.0), random) + random.between((-0.004, 0.004), 1, 1) * x.square()
    slope = torch.gradient(curve, dim=2)[0].clamp(-3.0, 3.0)
    half = random.log_between((0.5, 3.0), 1, 1) * (1.0 + slope.square()).sqrt()
    return (y - curve).abs() < half, random.between((-0.4, 0.4), 1, 1) * x / 120.0


def _from_lines(along: Tensor, pitch: Tensor) -> Tensor:
    """Distance from the nearest of lines that are a pitch apart."""
    return (along / pitch - (along / pitch).round()).abs() * pitch


def _net(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    pitch, half = random.log_between((5.0, 36.0), 1, 1), random.log_between((0.5, 2.2), 1, 1)
    second = torch.where(random.coin(0.5, 1, 1), 1.0, random.between((0.4, 2.5), 1, 1)) * pitch
    bent = y + 3.0 * torch.sin(x / 17.0 + 6 * random.uniform(1, 1)) * random.coin(0.5, 1, 1)
    lines = (_from_lines(x, pitch) < half) | (_from_lines(bent, second) < half)
    inside = _within(y, x, (20.0, 120.0), random)
    return lines & inside, random.between((-0.4, 0.4), 1, 1) * x / 120.0 + 0.03 * torch.sin(y / 23.0)


def _ladder(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    half, apart, pitch = (random.log_between(limits, 1, 1) for limits in ((0.6, 4.0), (6.0, 30.0), (6.0, 24.0)))
    rails = (y.abs() - apart).abs() < half
    rungs = (_from_lines(x, pitch) < 0.8 * half) & (y.abs() < apart)
    inside = (rails | rungs) & (x.abs() < random.between((30.0, 110.0), 1, 1))
    return inside, random.between((-0.5, 0.5), 1, 1) * x / 120.0


def _plant(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """Leaves that sway, each at a depth of its own."""
    inside, depth = torch.zeros_like(x, dtype=torch.bool), torch.zeros_like(x)
    for _ in range(5):
        foot, length = random.between((-25.0, 25.0), 1, 1), random.between((15.0, 80.0), 1, 1)
        bend = _wave(y, (2.0, 14.0), (8.0, 30.0), random)
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
    noise = smooth_noise(random, x.shape[-1])
    fade = (x.square() + y.square()).sqrt() / random.log_between((15.0, 80.0), 1, 1)
    height = noise + 1.0 - 1.5 * fade
    return height > 0.0, -random.between((0.0, 0.25), 1, 1) * height.clamp(0.0, 2.0)


def _blocks(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A field of rectangular blocks of random heights."""
    pitch = random.log_between((5.0, 30.0), 2, 1, 1)
    row, column = (y / pitch[:, 0]).floor(), (x / pitch[:, 1]).floor()
    hashed = torch.sin(12.9898 * row + 78.233 * column + 100.0 * random.uniform(1, 1)) * 43758.5453
    height = hashed - hashed.floor()
    inside = _within(y, x, (10.0, 80.0), random) & (height > random.between((-0.5, 0.5), 1, 1))
    return inside, -random.between((0.02, 0.5), 1, 1) * height


def _slab(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A steep rectangle."""
    extent = random.log_between((3.0, 60.0), 2, 1, 1)
    inside = (x.abs() < extent[:, 0]) & (y.abs() < extent[:, 1])
    steep = random.log_between((0.1, 1.0), 1, 1) / extent[:, 0]
    return inside, steep * x


def _sieve(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A plate with slits or square holes, through which one sees what is behind."""
    pitch = random.log_between((4.0, 40.0), 2, 1, 1)
    hole = random.log_between((0.7, 4.0), 2, 1, 1)
    slit = random.coin(0.5, 1, 1)
    open_ = (_from_lines(x, pitch[:, 0]) < hole[:, 0]) & (slit | (_from_lines(y, pitch[:, 1]) < hole[:, 1]))
    inside = _within(y, x, (12.0, 120.0), random)
    return inside & ~open_, (random.between((-0.4, 0.4), 1, 1) * x + random.between((-0.4, 0.4), 1, 1) * y) / 100.0


def _sea(y: Tensor, x: Tensor, random: Random) -> tuple[Tensor, Tensor]:
    """A sheet with round waves, flat to steep."""
    inside = _within(y, x, (15.0, 120.0), random)
    height = random.log_between((0.02, 0.4), 1, 1)
    return inside, height * torch.sin(x / random.log_between((2.0, 15.0), 1, 1)) + 0.2 * height * torch.sin(y / 9.0)


KINDS = (_plate, _ellipsoid, _rod, _rope, _net, _ladder, _plant, _chain, _rock, _blocks, _slab, _sieve, _sea)
"""Things in the scenes."""


# Crops, and the noise of a camera.

COUNT_BINS = (64, 96, 128, 192, 256, 400)
"""Bins of the histograms behind frames with few photons, one number for each batch."""

_RARER = 1.5  # power of a uniform number: low backscatter fractions are drawn more often than high ones
_WRONG = (0.5, 2.0)  # factors on a background, and on the width of a response, that are not known well
_FLOOR = 0.01  # part of the signal that may come in any bin, where a response is fitted
_ESTIMATED = 0.03, 0.1  # deviations of height and slope, relative, of a background that is estimated from the frame
_TAPS = 32  # a response extends over this many bins to each side


class Batch(NamedTuple):
    """Noisy frames and what they are of."""

    inputs: tuple[Tensor, ...]  # as networks take them: [B, 3, h, w]; or counts, background and response
    clean: Tensor  # depth over the gate, [B, 1, h, w]
    hit: Tensor  # where a target is seen, [B, 1, h, w]


class _Crops(NamedTuple):
    """Clean crops; lengths are over the gate that the network is given."""

    clean: Tensor  # depth, [B, h, w]
    sigma: Tensor  # its bound
    hit: Tensor  # where there is a target
    reach: Tensor  # depth behind which no backscatter comes from
    profile: Tensor  # of backscatter over the camera's gate, [B, BINS]
    camera: Tensor  # start and width of that gate, which is wider, [B, 2]
    seen: Tensor  # depth of the subpixels of each pixel, NaN where there is none, [B, n, h, w]
    bound: Tensor  # its bound


def draw_batch(
    scenes: CleanScenes,
    noise: Noise,
    *,
    size: int,
    crop: int,
    generator: torch.Generator,
    always_replaced: bool = False,
    histograms: bool = False,
    bins: int = 192,
    finer: int = 1,
) -> Batch:
    """`size` pairs of `crop` × `crop` pixels, on the scenes' device, which is the generator's.

    A tenth of the samples has no pixels that report backscatter, unless `always_replaced`. With `histograms` they are
    counts of so many `bins`. `finer`: of the scenes.
    """
    random = Random(size, generator)
    crops = _draw_crops(scenes, noise, crop, random, finer)
    hit = crops.hit[:, None].float()
    if histograms:
        photons, sbr = random.log_between(noise.photons), random.log_between(noise.sbr)
        cubes, level, response = _draw_counts(crops, photons, photons / sbr, noise, generator, bins)
        return Batch((cubes, level[:, None, None], response), crops.clean[:, None], hit)
    reported, present = _report(crops, noise, random, always_replaced)
    counted = round(noise.counting * size)
    if counted:
        photons, sbr = random.log_between(noise.photons)[:counted], random.log_between(noise.sbr)[:counted]
        some = _Crops(*(values[:counted] for values in crops))
        counts, level, response = _draw_counts(some, photons, photons / sbr, noise, generator, bins)
        # Log-likelihood of a return at bin k: Σ_j n_j ln(1 + S h_{j−k} / B_j), for all k at once.
        gain = torch.log1p(photons[:, None, None] * toeplitz(response, bins) / level[:, :, None])  # [B, j, k]
        reported[:counted] = highest(torch.bmm(counts.flatten(1, 2), gain).view_as(counts))
        present[:counted] = counts.sum(dim=-1) > 0
    reported, present = _defects(reported, present, noise, random)
    reported = torch.where(present, reported, 1.0)
    known = torch.where(random.coin(noise.unknown_water)[:, None], 1.0, crops.profile)
    start, width = crops.camera[:, 0, None, None], crops.camera[:, 1, None, None]
    place = ((reported - start) / width * BINS).long().clamp(0, BINS - 1).flatten(1)
    density = known.gather(1, place).clamp(math.exp(-LOG_DENSITY_LIMIT), math.exp(LOG_DENSITY_LIMIT)).view_as(reported)
    frame = torch.stack([reported, present.float(), torch.where(present, density.log(), 0.0)], dim=1)
    return Batch((frame,), crops.clean[:, None], hit)


def _report(crops: _Crops, noise: Noise, random: Random, always_replaced: bool) -> tuple[Tensor, Tensor]:
    """Reported depths over the gate, and which pixels report, `[B, h, w]`: the target's, or backscatter's."""
    clean, sigma, hit, reach, profile, camera, _, _ = crops
    start, width = camera[:, 0, None, None], camera[:, 1, None, None]
    reported = clean + sigma * random.normal(*clean.shape[1:])
    late = (sigma * random.between((0.5, 3.0), 1, 1)) * -torch.log1p(-random.uniform(*clean.shape[1:]))
    reported = reported + torch.where(random.coin(noise.tail, 1, 1), late, 0.0)
    none = random.coin(0.0 if always_replaced else 0.1)
    rare = random.uniform().pow(_RARER) * (noise.backscatter[1] - noise.backscatter[0])
    share = torch.where(none, 0.0, noise.backscatter[0] + rare)[:, None, None]
    # Dark pixels report backscatter more often.
    typical = torch.where(hit, sigma, 0.0).flatten(1).sum(1) / hit.flatten(1).sum(1).clamp_min(1)
    darker = (sigma / typical.clamp_min(1e-9)[:, None, None]).clamp(0.3, 2.5)
    uneven = random.coin(0.0 if always_replaced else 0.4, 1, 1)
    share = torch.where(uneven & hit, (share * darker).clamp_max(0.75), share)
    # Open water reports as often as targets are outshone, or at a rate of its own, or always, or never.
    kind, rate = random.uniform(1, 1), random.uniform(1, 1)
    rate = torch.where(kind < 0.1, 0.0, torch.where(kind > 0.9, 1.0, rate))
    share = torch.where(hit | (kind.sub(0.5).abs() < 0.25), share, rate)
    replaced = random.uniform(*clean.shape[1:]) < share
    backscatter = start + width * _backscatter_depth(profile, (reach - start) / width, random.uniform(*clean.shape[1:]))
    # A gate opens at one range, which is nearer in depth towards the corners of the view.
    nearer = torch.where(random.coin(noise.slanted_gate), 0.15 * random.uniform(), 0.0)[:, None, None]
    reported = torch.where(replaced, backscatter - nearer * (1.0 - backscatter), reported)
    return reported, hit | replaced


def _defects(reported: Tensor, present: Tensor, noise: Noise, random: Random) -> tuple[Tensor, Tensor]:
    """The same with hot pixels, dead ones, pixels that saw no photon, and nothing far outside the gate."""
    shape = reported.shape[1:]
    hot = torch.where(random.coin(0.3, 1, 1), noise.hot * random.uniform(1, 1), 0.0)
    stuck = random.uniform(*shape) < hot
    reported = torch.where(stuck, random.uniform(*shape), reported)
    present = present | stuck
    dead = torch.where(random.coin(0.7, 1, 1), 0.0, noise.dead * random.uniform(1, 1))
    answering = torch.where(random.coin(noise.sparse, 1, 1), random.log_between((0.03, 1.0), 1, 1), 1.0)
    present = present & (random.uniform(*shape) >= dead) & (random.uniform(*shape) < answering)
    return reported, present & (reported > -MARGIN) & (reported < 1.0 + MARGIN)


def _draw_crops(scenes: CleanScenes, noise: Noise, crop: int, random: Random, finer: int) -> _Crops:
    """Crops of random scenes, each with a gate and a water."""
    index = random.integer(len(scenes.depth))
    seen, bound = _cut(scenes, index, crop, random, finer)
    if noise.resampled > 0.0:
        chosen = random.coin(noise.resampled, 1, 1, 1)
        means = (image.nanmean(dim=1, keepdim=True) for image in (seen, bound))
        seen, bound = (torch.where(chosen, *pair) for pair in zip(means, (seen, bound), strict=True))
    depth, sigma = (image[:, seen.shape[1] // 2] for image in (seen, bound))
    hit = torch.isfinite(depth) & torch.isfinite(sigma)
    gate = scenes.gate[index]
    own = random.coin(noise.own_gate)
    low, high = _extent(depth, hit, gate)
    width = torch.maximum(random.log_between(noise.gate_width), 1.02 * (high - low))
    start = torch.where(own, gate[:, 0], low - (width - (high - low)) * random.uniform())
    width = torch.where(own, gate[:, 1] - gate[:, 0], width)
    if noise.cut > 0.0:
        end = torch.lerp(low, high, random.between((0.5, 1.0)))
        width = torch.where(random.coin(noise.cut), torch.maximum(end - start, 0.05 * width), width)
    clean = (depth - start[:, None, None]) / width[:, None, None]
    hit &= (clean >= 0.0) & (clean < 1.0)
    clean = torch.where(hit, clean, 1.0)
    seen = (seen - start[:, None, None, None]) / width[:, None, None, None]
    seen = torch.where((seen >= 0.0) & (seen < 1.0), seen, math.nan)
    scale = random.log_between(noise.sigma_scale)[:, None, None] / width[:, None, None]
    sigma, bound = torch.where(hit, sigma * scale, 0.0), bound * scale[:, None]

    centres = (torch.arange(BINS, device=depth.device) + 0.5) / BINS
    decay = torch.where(random.coin(0.45), 0.0, random.log_between(noise.decay))
    flat = torch.where(random.coin(0.5), 0.0, 0.3 * random.uniform())[:, None]
    falling = torch.softmax(-decay[:, None] * centres, dim=1) * BINS
    own_profile = (own & random.coin(noise.own_profile))[:, None]
    profile = torch.where(own_profile, scenes.profile[index], (1 - flat) * falling + flat)
    around = torch.where(random.coin(noise.wide_gate)[:, None], random.log_between((0.05, 3.0), 2), 0.0)
    around[: round(noise.counting * len(clean))] = 0.0
    camera = torch.stack([-around[:, 0], 1.0 + around.sum(dim=1)], dim=1)
    end = camera.sum(dim=1)[:, None, None]
    reach = torch.where(random.coin(noise.behind)[:, None, None] | ~hit, end, clean)
    return _Crops(clean, sigma, hit, reach, profile, camera, seen, bound)


def _cut(scenes: CleanScenes, index: Tensor, crop: int, random: Random, finer: int) -> tuple[Tensor, Tensor]:
    """Depth and bound of the subpixels of crops `[B, n, h, w]`, rotated and mirrored in one of eight ways."""

    def positions(length: int) -> Tensor:
        first = random.integer(length // finer - crop + 1, 1)
        along = torch.arange(crop, device=first.device)
        place = first + torch.where(random.coin(0.5, 1), crop - 1 - along, along)
        return finer * place[:, None] + torch.arange(finer, device=first.device)[:, None]  # [B, finer, crop]

    rows, columns = positions(scenes.depth.shape[1]), positions(scenes.depth.shape[2])
    where = index[:, None, None, None, None], rows[:, :, None, :, None], columns[:, None, :, None, :]
    depth, sigma = (values[where].flatten(1, 2) for values in scenes[:2])
    transposed = random.coin(0.5)[:, None, None, None]
    return torch.where(transposed, depth.mT, depth), torch.where(transposed, sigma.mT, sigma)


def _extent(depth: Tensor, hit: Tensor, gate: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest and farthest depth of each image `[B, h, w]`; the gate `[1 or B, 2]` where it sees nothing."""
    low = torch.where(hit, depth, math.inf).flatten(1).amin(dim=1)
    high = torch.where(hit, depth, -math.inf).flatten(1).amax(dim=1)
    seen = hit.flatten(1).any(dim=1)
    return torch.where(seen, low, gate[:, 0]), torch.where(seen, high, gate[:, 1])


def _backscatter_depth(profile: Tensor, reach: Tensor, u: Tensor) -> Tensor:
    """Depths of backscatter nearer than `reach`, by inversion of the profiles' distribution at u; `[B, H, W]`."""
    size, bins = profile.shape
    cumulative = torch.cat([profile.new_zeros(size, 1), profile.cumsum(dim=1)], dim=1) / bins
    cumulative = cumulative / cumulative[:, -1:].clamp_min(1e-12)
    wanted = u.flatten(1) * interpolated(cumulative, reach.flatten(1) * bins)
    upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, bins)
    first, last = cumulative.gather(1, upper - 1), cumulative.gather(1, upper)
    inside = (wanted - first) / (last - first).clamp_min(1e-12)
    return ((upper - 1 + inside.clamp(0.0, 1.0)) / bins).view_as(reach)


class _Response(NamedTuple):
    """An instrument response, mean 0: a Gaussian whose sides differ.

    In some samples a part of the light is in one that is three times as wide, and another part comes late, by a power
    law, as in detectors to whose junction carriers diffuse.
    """

    early: Tensor  # deviations of the sides [bins], [B, 1]
    late: Tensor
    wide: Tensor  # part of the light in the wider one, [B, 1]
    tail: Tensor  # part of the light in the tail, [B, 1]
    decay: Tensor  # its mean delay [bins], [B, 1]

    def before(self, time: Tensor) -> Tensor:
        """Part of the light before times `[…, n]` [bins]."""
        both, total = (self.late - self.early) * math.sqrt(2.0 / math.pi), self.early + self.late
        time = time + self.tail * (self.decay - both)

        def one(width: float) -> Tensor:
            at = time / width + both
            first = 2.0 * self.early * torch.special.ndtr(at / self.early).clamp_max(0.5)
            return (first + self.late * (2.0 * torch.special.ndtr(at / self.late) - 1.0).clamp_min(0.0)) / total

        slow = 1.0 - (1.0 + 0.5 * (time + both).clamp_min(0.0) / self.decay) ** -3
        return torch.lerp(torch.lerp(one(1.0), one(3.0), self.wide), slow, self.tail)

    def per_bin(self, shift: Tensor | float = 0.0) -> Tensor:
        """`[B, 2 _TAPS + 1]`, sum 1, of a response that comes `shift` bins later, `[B, 1]`."""
        edges = torch.arange(-_TAPS - 0.5, _TAPS + 1.0, device=self.early.device)
        taps = self.before(edges - shift).diff(dim=-1)
        return taps / taps.sum(dim=-1, keepdim=True)


def _draw_response(random: Random) -> _Response:
    width, ratio = random.log_between((0.6, 5.0), 1), random.log_between((1.0, 3.0), 1)
    ratio = torch.where(random.coin(0.5, 1), 1.0, torch.where(random.coin(0.8, 1), ratio, 1.0 / ratio))
    wide = 0.3 * random.uniform(1) * random.coin(0.3, 1)
    tail = random.between((0.05, 0.8), 1) * random.coin(0.4, 1)
    return _Response(width / ratio.sqrt(), width * ratio.sqrt(), wide, tail, random.log_between((1.0, 8.0), 1))


def _wrong_response(true: Tensor, random: Random) -> tuple[_Response, Tensor]:
    """A Gaussian for a response `[B, 2 _TAPS + 1]` that is not known well, and where it fits best, `[B, 1]` [bins].

    Its deviation is wrong by up to a factor of 2. Who knows no better has measured the offset with it, too.
    """
    width = deviation(true, 0.0)[:, None] * random.log_between(_WRONG, 1)
    width, none = width.clamp(0.3, _TAPS / 3.0), torch.zeros_like(width)
    found = _Response(width, width, none, none, none + 1.0)
    shift = torch.arange(-60.0, 61.0, device=true.device)[:, None] * 0.1
    shifted = _Response(*(part[..., None] for part in found)).per_bin(shift)  # [B, shifts, 2 _TAPS + 1]
    fit = (shifted + _FLOOR).log() @ true[..., None]
    return found, shift[fit[..., 0].argmax(dim=1)]


def _draw_counts(
    crops: _Crops, photons: Tensor, background: Tensor, noise: Noise, generator: torch.Generator, bins: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Poisson counts `[B, h, w, T]`, background per bin `[B, T]` and response `[B, 2 r + 1]` as they are given."""
    clean, sigma, hit, reach, profile, _, seen, bound = crops
    device, subpixels = clean.device, seen.shape[1]
    random = Random(len(clean), generator)
    response = _draw_response(random)
    # Where the response is not known well, depth is where the one that is given fits best.
    true = response.per_bin()
    gaussian, fits_at = _wrong_response(true, random)
    wrong = random.coin(noise.wrong, 1)
    true, given = torch.where(wrong, response.per_bin(-fits_at), true), torch.where(wrong, gaussian.per_bin(), true)
    # Signal follows the bound: σ ∝ 1/√signal.
    typical = torch.where(hit, sigma, 0.0).flatten(1).sum(1) / hit.flatten(1).sum(1).clamp_min(1)
    each = (typical[:, None, None, None] / bound.clamp_min(1e-9)).square().clamp(0.05, 4.0)
    each = torch.where(seen.isfinite() & ~bound.isnan(), each, 0.0)  # a surface in the dark has no bound
    if subpixels > 1:  # in half of the samples all of them, and in half of these with the noise of few photons
        sees_area, rough = random.coin(0.5, 1, 1, 1), random.coin(0.5, 1, 1, 1)
        each = torch.where(rough & sees_area, -each * torch.log1p(-random.uniform(*each.shape[1:])), each)
        middle = torch.arange(subpixels, device=device) == subpixels // 2
        each = each * torch.where(sees_area, 1.0 / subpixels, middle[:, None, None].float())
    shade = each.sum(dim=1)

    edges = torch.arange(bins + 1, device=device, dtype=torch.float32)
    level = torch.nn.functional.interpolate(profile[:, None], size=bins, mode="nearest")[:, 0]
    ambient = random.coin(noise.ambient)
    place = (edges[1:] - 0.5) / bins
    bump = random.coin(0.3, 1) * 2.0 * random.uniform(1)  # of light that is scattered often
    level = level * (1.0 + bump * torch.exp(-0.5 * ((place - random.uniform(1)) / random.between((0.05, 0.4), 1)) ** 2))
    level = torch.where(ambient[:, None], 1.0, level / level.mean(dim=1, keepdim=True))
    level = background[:, None] * level / bins + 1e-4
    mean = torch.where(hit, shade, 0.0).flatten(1).sum(1) / hit.flatten(1).sum(1).clamp_min(1)
    bright = torch.where(ambient[:, None, None] & hit, shade / mean.clamp_min(1e-3)[:, None, None], 1.0)

    second, share = _second_surface(clean, hit, noise, random)
    rate = torch.zeros(*clean.shape, bins, device=device)
    signals = *(signal * (1.0 - share) for signal in each.unbind(dim=1)), shade * share
    for depth, signal in zip((*seen.unbind(dim=1), second), signals, strict=True):
        at = (depth.nan_to_num(-9.0) * bins - 0.5)[..., None]
        near = at.floor() + edges[:2]  # the two bins whose middles are next to the return share it
        part = (signal * photons[:, None, None])[..., None] * (1.0 - (near - at).abs())
        inside = (near >= 0) & (near < bins)
        rate.scatter_add_(-1, near.long().clamp(0, bins - 1), torch.where(inside, part, 0.0))
    scattered = round(noise.scattered * len(clean))
    if scattered:
        rate[:scattered] = _scattered(rate[:scattered], photons[:scattered], noise, generator)
    rate = torch.bmm(rate.flatten(1, 2), toeplitz(true, bins).mT).view_as(rate)
    from_before = (edges[:-1] < (reach * bins)[..., None]) | ambient[:, None, None, None]
    rate += level[:, None, None] * bright[..., None] * from_before
    counts = torch.poisson(rate.add_(1e-4), generator=generator)
    level = level * torch.where(random.coin(noise.wrong, 1), random.log_between(_WRONG, 1), 1.0)
    height, slope = (random.normal(1) * random.coin(0.5, 1) for _ in range(2))
    level = level * torch.exp(_ESTIMATED[0] * height + _ESTIMATED[1] * slope * (place - 0.5))
    if noise.halves > 0.0:  # chosen samples are those of a camera with bins twice as wide, in halves
        chosen = random.coin(noise.halves, 1)
        counted, known, taps = halved(*rebinned(counts, level, given, 2))
        counts, level = torch.where(chosen[..., None, None], counted, counts), torch.where(chosen, known, level)
        given = torch.where(chosen, taps[:, 1:-1], given)
    return counts, level, given


def _second_surface(clean: Tensor, hit: Tensor, noise: Noise, random: Random) -> tuple[Tensor, Tensor]:
    """Depth of a weaker second surface in a pixel, and its part of the pixel's signal, `[B, h, w]`.

    Either the neighbour's, where a pixel straddles an edge, or a veil before or behind parts of the scene.
    """
    side = clean.shape[-1]
    apart = random.between((0.03, 0.4), 1, 1) * (1.0 - 2.0 * random.coin(0.5, 1, 1).float())
    veiled = smooth_noise(random, side)[:, : clean.shape[1]] > random.between((-0.5, 1.0), 1, 1)
    beside = random.coin(0.5, 1, 1)
    second = torch.where(beside, clean.roll(1, 2), (clean + apart).clamp(0.01, 0.99))
    there = hit & torch.where(beside, hit.roll(1, 2) & ((second - clean).abs() > 0.005), veiled)
    share = torch.where(beside, random.between((0.0, 0.45), *clean.shape[1:]), random.between((0.05, 0.45), 1, 1))
    return second, torch.where(there & random.coin(noise.two_returns, 1, 1), share, 0.0)


def _scattered(rate: Tensor, photons: Tensor, noise: Noise, generator: torch.Generator) -> Tensor:
    """The signal rate `[B, h, w, T]` with a part of it scattered forward, before it met the target and afterwards.

    What water scatters at a distance d before a target of range D is seen φ beside it on a path that is longer by
    φ² D (D − d) / 2 d: light from near the camera is as early as the target's. So at every φ the delay is mostly far
    less than before. Single scattering by a lobe of phase function gives a radiance that falls as 1 / φ within it and
    as 1 / φ³ outside: here three Gaussians. The part of the light follows from the optical depth. Energy is conserved,
    except for what leaves the gate. The light beside may come in few `events`, as in Monte Carlo histograms.
    """
    size, height, width, bins = rate.shape
    device, random = rate.device, Random(size, generator)

    def delayed(mean: Tensor) -> Tensor:
        """Share of a return in bin k that arrives in bin j, `[B, k, j]`."""
        bin = torch.arange(bins, device=device)
        delay = bin - bin[:, None]
        decay = torch.exp(-1.0 / (mean * bins).clamp_min(0.05))
        return torch.where(delay >= 0, (1.0 - decay) * decay ** delay.clamp_min(0), 0.0)

    def spread(length: int, scale: Tensor) -> Tensor:
        place = torch.arange(length, device=device)
        weight = torch.exp(-0.5 * ((place - place[:, None]) / scale).square())
        return weight / weight.sum(dim=2, keepdim=True)

    delay, scale = random.log_between(noise.delay, 1, 1), random.log_between(noise.spread, 1, 1)
    growth, parts = random.log_between((2.0, 5.0), 1, 1), random.uniform(3)
    thin = 1.0 - torch.exp(-random.log_between((0.01, 3.0), 1, 1))
    share = torch.where(random.coin(noise.halo, 1, 1), thin, random.uniform(1, 1))
    late, early = delayed(delay), delayed(delay / growth.square())
    rate = torch.lerp(rate.flatten(1, 2), torch.bmm(rate.flatten(1, 2), late), share)
    back = torch.bmm(rate, torch.lerp(early, late, random.uniform(1, 1) / growth)).unflatten(1, (height, width))
    rate, light = rate.view_as(back), torch.zeros_like(back)
    for power, part in zip((-1, 0, 1), (parts / parts.sum(dim=1, keepdim=True)).unbind(dim=1), strict=True):
        factor = scale * growth**power
        across = torch.matmul(spread(width, factor)[:, None], back)
        light += part[:, None, None, None] * torch.bmm(spread(height, factor), across.flatten(2)).view_as(rate)
    event = (photons / random.log_between(noise.events))[:, None, None, None] * random.normal(*rate.shape[1:3], 1).exp()
    light = torch.poisson(light.div_(event), generator=generator).mul_(event)
    return torch.lerp(rate, light, share[..., None])
