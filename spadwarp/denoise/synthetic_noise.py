"""Training pairs drawn where the network learns: crops of clean scenes, and what a SPAD camera reports of them.

A noisy frame is never stored. Each step draws crops, gates, waters and photons anew, so no two frames of a training are
alike. Depth is over the gate: 0 at its start, 1 at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from spadwarp.denoise.frames import LOG_DENSITY_LIMIT, MARGIN
from spadwarp.denoise.histogram_features import WINDOWS, histogram_clues, toeplitz
from spadwarp.denoise.recipe import Noise

__all__ = ["BINS", "Batch", "CleanScenes", "draw_batch", "log_density"]

BINS = 64  # of a backscatter profile over the gate
_COUNT_BINS = 192  # of the histograms behind frames with few photons
_TAPS = 5  # a response reaches this many bins to each side


@dataclass(frozen=True, eq=False)
class CleanScenes:
    """Clean scenes on the training device.

    Attributes:
        depth: float32 `[S, H, W]` [m]; NaN where nothing is hit.
        sigma: Cramér–Rao bound of depth, float32 `[S, H, W]` [m]; NaN where there is none.
        gate: (start, stop) in depth, float32 `[S, 2]` [m].
        profile: Density of backscatter over the gate, mean 1, float32 `[S, BINS]`.
    """

    depth: Tensor
    sigma: Tensor
    gate: Tensor
    profile: Tensor

    def __len__(self) -> int:
        return len(self.depth)

    def to(self, device: torch.device | str) -> CleanScenes:
        """The same on another device."""
        return CleanScenes(*(one.to(device) for one in (self.depth, self.sigma, self.gate, self.profile)))


@dataclass(frozen=True, eq=False)
class Batch:
    """Noisy frames as networks take them, `[B, 3, h, w]`, or `[B, 3 + CLUES, h, w]` with histograms; clean depth over
    the gate and target seen, `[B, 1, h, w]`."""

    frame: Tensor
    clean: Tensor
    hit: Tensor


def draw_batch(
    scenes: CleanScenes,
    noise: Noise,
    *,
    size: int,
    crop: int,
    generator: torch.Generator,
    always_replaced: bool = False,
    histograms: bool = False,
) -> Batch:
    """`size` pairs of `crop` × `crop` pixels, on the scenes' device; one in ten without backscatter pixels, or none.

    With `histograms`, all samples are of counts and have the channels for them.
    """
    device = scenes.depth.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, device=device)

    def between(limits: tuple[float, float]) -> Tensor:
        return limits[0] + (limits[1] - limits[0]) * uniform(size)

    def log_between(limits: tuple[float, float]) -> Tensor:
        return torch.exp(math.log(limits[0]) + math.log(limits[1] / limits[0]) * uniform(size))

    def coin(share: float) -> Tensor:
        return uniform(size) < share

    index = torch.randint(len(scenes), (size,), generator=generator, device=device)
    depth, sigma = _crops(scenes, index, crop, generator)
    hit = torch.isfinite(depth) & torch.isfinite(sigma)

    # Gate and water
    own = coin(noise.own_gate)
    low, high = _extent(depth, hit, scenes.gate[index])
    width = torch.maximum(log_between(noise.gate_width), 1.02 * (high - low))
    start = low - (width - (high - low)) * uniform(size)
    start = torch.where(own, scenes.gate[index, 0], start)
    width = torch.where(own, scenes.gate[index, 1] - scenes.gate[index, 0], width)
    clean = (depth - start[:, None, None]) / width[:, None, None]
    hit &= (clean >= 0.0) & (clean < 1.0)
    clean = torch.where(hit, clean, 1.0)
    sigma = torch.where(hit, sigma / width[:, None, None], 0.0) * log_between(noise.sigma_scale)[:, None, None]

    centres = (torch.arange(BINS, device=device) + 0.5) / BINS
    decay = torch.where(coin(0.2), 0.0, log_between(noise.decay))
    flat = torch.where(coin(0.5), 0.0, 0.3 * uniform(size))[:, None]
    falling = torch.softmax(-decay[:, None] * centres, dim=1) * BINS
    profile = torch.where((own & coin(noise.own_profile))[:, None], scenes.profile[index], (1 - flat) * falling + flat)

    # Photons
    reach = torch.where(coin(noise.behind)[:, None, None], 1.0, clean)  # backscatter comes from nearer than this
    reported = clean + sigma * torch.randn(clean.shape, generator=generator, device=device)
    share = torch.where(coin(0.0 if always_replaced else 0.1), 0.0, between(noise.backscatter))[:, None, None]
    stray = uniform(size, crop, crop) < share
    strays = _strays(profile, reach, uniform(size, crop, crop))
    # A gate opens at one range, which is nearer in depth towards the corners of the view.
    nearer = torch.where(coin(noise.slanted_gate), 0.15 * uniform(size), 0.0)[:, None, None]
    strays = strays - nearer * (1.0 - strays)
    reported = torch.where(stray, strays, reported)
    present = hit | (stray & coin(0.5)[:, None, None])

    counted = round(noise.counting * size)
    clues = None
    if counted:
        photons, background = log_between(noise.photons)[:counted], log_between(noise.sbr)[:counted]
        reported[:counted], present[:counted], clues = _counting(
            clean[:counted], hit[:counted], sigma[:counted], reach[:counted], profile[:counted],
            photons, photons / background, noise, generator, histograms=histograms,
        )  # fmt: skip
    dead = torch.where(coin(0.7), 0.0, noise.dead * uniform(size))[:, None, None]
    present &= (uniform(size, crop, crop) >= dead) & (reported > -MARGIN) & (reported < 1.0 + MARGIN)

    reported = torch.where(present, reported, 1.0)
    known = torch.where(coin(noise.unknown_water)[:, None], 1.0, profile)
    density = torch.where(present, log_density(known, reported), 0.0)
    frame = torch.stack([reported, present.float(), density], dim=1)
    if clues is not None:
        clues[:, : len(WINDOWS)] -= 0.5
        frame = torch.cat([frame, clues], dim=1)
    return Batch(frame, clean[:, None], hit[:, None].float())


def log_density(profile: Tensor, depth: Tensor) -> Tensor:
    """ln of the profiles `[B, bins]` (mean 1) at depths over the gate `[B, H, W]`, within ±`LOG_DENSITY_LIMIT`."""
    bins = profile.shape[1]
    place = (depth.flatten(1) * bins).long().clamp(0, bins - 1)
    limit = LOG_DENSITY_LIMIT
    return profile.gather(1, place).clamp(math.exp(-limit), math.exp(limit)).log().view_as(depth)


def _crops(scenes: CleanScenes, index: Tensor, crop: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Depth and bound of crops, turned and mirrored in one of eight ways."""
    device = scenes.depth.device
    count = len(index)

    def places(length: int) -> Tensor:
        first = torch.randint(length - crop + 1, (count, 1), generator=generator, device=device)
        along = torch.arange(crop, device=device)
        mirrored = torch.rand(count, 1, generator=generator, device=device) < 0.5
        return first + torch.where(mirrored, crop - 1 - along, along)

    rows, columns = places(scenes.depth.shape[1]), places(scenes.depth.shape[2])
    where = index[:, None, None], rows[:, :, None], columns[:, None, :]
    depth, sigma = scenes.depth[where], scenes.sigma[where]
    turned = (torch.rand(count, generator=generator, device=device) < 0.5)[:, None, None]
    return torch.where(turned, depth.mT, depth), torch.where(turned, sigma.mT, sigma)


def _extent(depth: Tensor, hit: Tensor, gate: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest and farthest depth of each crop; the scene's gate where it sees nothing."""
    low = torch.where(hit, depth, math.inf).flatten(1).amin(dim=1)
    high = torch.where(hit, depth, -math.inf).flatten(1).amax(dim=1)
    seen = hit.flatten(1).any(dim=1)
    return torch.where(seen, low, gate[:, 0]), torch.where(seen, high, gate[:, 1])


def _strays(profile: Tensor, reach: Tensor, u: Tensor) -> Tensor:
    """Depths of backscatter nearer than `reach`, by inversion of the profiles' distribution at u; `[B, H, W]`."""
    size, bins = profile.shape
    cumulative = torch.cat([profile.new_zeros(size, 1), profile.cumsum(dim=1)], dim=1) / bins
    cumulative = cumulative / cumulative[:, -1:].clamp_min(1e-12)
    place = reach.flatten(1).clamp(0.0, 1.0) * bins
    below = place.long().clamp(max=bins - 1)
    limit = torch.lerp(cumulative.gather(1, below), cumulative.gather(1, below + 1), place - below)
    wanted = u.flatten(1) * limit
    upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, bins)
    first, last = cumulative.gather(1, upper - 1), cumulative.gather(1, upper)
    inside = (wanted - first) / (last - first).clamp_min(1e-12)
    return ((upper - 1 + inside.clamp(0.0, 1.0)) / bins).view_as(reach)


def _counting(
    clean: Tensor,
    hit: Tensor,
    sigma: Tensor,
    reach: Tensor,
    profile: Tensor,
    photons: Tensor,
    background: Tensor,
    noise: Noise,
    generator: torch.Generator,
    *,
    histograms: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Maximum-likelihood depth from histograms of Poisson counts, where there were counts, and the clues."""
    size, device = len(clean), clean.device
    bins = _COUNT_BINS
    width = (0.6 + 1.2 * torch.rand(size, generator=generator, device=device))[:, None]  # σ of the response [bins]
    # Brightness follows the bound: σ ∝ 1/√signal.
    typical = torch.where(hit, sigma, 0.0).flatten(1).sum(1) / hit.flatten(1).sum(1).clamp_min(1)
    shade = (typical[:, None, None] / sigma.clamp_min(1e-9)).square().clamp(0.05, 4.0)
    signal = torch.where(hit, shade * photons[:, None, None], 0.0)

    edges = torch.arange(bins + 1, device=device, dtype=torch.float32)
    level = torch.nn.functional.interpolate(profile[:, None], size=bins, mode="nearest")[:, 0]
    level = background[:, None] * level / bins + 1e-4  # expected background counts per bin
    phase = (edges - (clean * bins)[..., None]).div_(width[:, None, None])
    rate = torch.special.ndtr(phase).diff(dim=-1).mul_(signal[..., None])
    scattered = round(noise.scattered * size)
    if scattered:
        rate[:scattered] = _scattered(rate[:scattered], noise, generator)
    rate += level[:, None, None] * (edges[:-1] < (reach * bins)[..., None])
    counts = torch.poisson(rate.add_(1e-4), generator=generator)
    del rate, phase

    # Log-likelihood of a return at bin k: Σ_j n_j ln(1 + S h_{j−k} / B_j), all k at once as a product of matrices.
    apart = torch.arange(-_TAPS, _TAPS + 1, device=device)
    response = torch.exp(-0.5 * (apart / width).square())
    response = response / response.sum(dim=1, keepdim=True)
    gain = torch.log1p(photons[:, None, None] * toeplitz(response, bins) / level[:, :, None])  # [B, j, k]
    score = torch.bmm(counts.flatten(1, 2), gain).view_as(counts)
    best = score.argmax(dim=-1, keepdim=True)
    clues = histogram_clues(counts, level[:, None, None], response) if histograms else None

    # Centroid of the counts within 2σ about the best bin.
    offsets = torch.arange(-4, 5, device=device)
    near = (best + offsets).clamp(0, bins - 1)
    weight = counts.gather(-1, near) * (offsets.abs() <= 2 * width)[:, None, None]
    total = weight.sum(dim=-1)
    centroid = (weight * (near + 0.5)).sum(dim=-1) / total.clamp_min(1e-9)
    depth = torch.where(total > 0, centroid, best[..., 0] + 0.5)
    return depth / bins, counts.sum(dim=-1) > 0, clues


def _scattered(rate: Tensor, noise: Noise, generator: torch.Generator) -> Tensor:
    """A part of the signal `[B, h, w, T]`, in half of the frames nearly all of it, late and spread over the image.

    Light that water scatters forward has longer ways: its delays are drawn as a sum of two exponentials, after a first
    delay; and it comes from beside the pixel, by an exponential in rows and in columns. Energy is kept, but for what
    leaves the gate. Its rate may be rough, as histograms of a simulation with few photons are.
    """
    size, height, width, bins = rate.shape
    device = rate.device

    def uniform() -> Tensor:
        return torch.rand(size, 1, 1, generator=generator, device=device)

    def log_between(limits: tuple[float, float]) -> Tensor:
        return torch.exp(math.log(limits[0]) + math.log(limits[1] / limits[0]) * uniform())

    def lateness(mean: Tensor) -> Tensor:
        """Share that a return in bin k has in bin j, `[B, k, j]`."""
        late = torch.arange(bins, device=device)
        late = late - late[:, None]
        decay = torch.exp(-1.0 / (mean * bins).clamp_min(0.05))
        return torch.where(late >= 0, (1.0 - decay) * decay ** late.clamp_min(0), 0.0)

    def spread(length: int, scale: Tensor) -> Tensor:
        place = torch.arange(length, device=device)
        weight = torch.exp(-(place - place[:, None]).abs() / scale)
        return weight / weight.sum(dim=2, keepdim=True)

    delay, slow = log_between(noise.delay), 0.6 * uniform()
    late = (1.0 - slow) * lateness(delay) + slow * lateness(delay * (2.0 + 4.0 * uniform()))
    late = lateness(delay * 0.7 * uniform()) @ late
    scale = log_between(noise.spread)
    spread_light = torch.bmm(rate.flatten(1, 2), late).view_as(rate)
    spread_light = torch.matmul(spread(width, scale)[:, None], spread_light)
    spread_light = torch.bmm(spread(height, scale), spread_light.flatten(2)).view_as(rate)
    rough = (noise.roughness[0] + (noise.roughness[1] - noise.roughness[0]) * uniform())[..., None]
    if noise.roughness[1] > 0:
        grain = torch.randn(rate.shape, generator=generator, device=device)
        spread_light *= grain.mul_(rough).sub_(0.5 * rough.square()).exp_()
    share = torch.where(uniform() < 0.5, uniform(), 0.95 + 0.05 * uniform())[..., None]
    return torch.lerp(rate, spread_light, share)
