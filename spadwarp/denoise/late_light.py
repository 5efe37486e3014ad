"""What tells light that water scattered forward, beside a bright target, from a dim target.

Both have the depth of a target and far more counts than backscatter. The scattered light is a few per cent as bright as
the target beside it, and later: less of it arrives within the instrument response around its peak.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.classical import pooled

LIGHT = 14
"""Number of channels of `light_channels`."""

_NEAR, _FAR = 10, 30  # pixels within which the brightest neighbourhood is looked for
_WINDOWS = 3, 7  # sides of the windows whose counts are summed [pixels]
_REACHES = 2.0, 8.0  # half widths around the peak, in deviations of the instrument response


def light_channels(above: Tensor, background: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Brightness and lateness of the light of each pixel, `LIGHT` times `[B, H, W]`.

    Logarithms of the excess over the background: of 3 × 3 pixels, relative to the background, and relative to the
    brightest 3 × 3 pixels around; the same of the pixel alone. Then the parts of the excess near the peak, in a wider
    interval around it, and after that, over 3 × 3 and 7 × 7 pixels; and the differences of these from the means around
    the pixel, in which bright pixels count most.

    `above`: counts less the expected background, `[B, H, W, T]`; `background`: of each bin, mean over the frame,
    `[B, T]`; `place`: of each pixel's peak over the gate; `response`: `[B, 2 r + 1]`, sum 1.
    """
    level = background.sum(dim=-1)[:, None, None]
    excess = above.sum(dim=-1)
    bright = _around(excess, 3).clamp_min(0.0)
    most = [_brightest(bright, reach) for reach in (_NEAR, _FAR)]
    parts = _parts(above, place, response)
    wide = [_around(part, side) for side in _WINDOWS for part in (excess, *parts)]
    shares = []
    for number, side in enumerate(_WINDOWS):
        whole, *some = wide[4 * number : 4 * number + 4]
        noise = (whole.clamp_min(0.0) + level + 0.5).sqrt() / side
        shares += [(part / (whole.clamp_min(0.0) + noise)).clamp(-1.0, 2.0) for part in some]
    weight = bright.square() + 1e-6
    far = 2 * _FAR + 1
    total = _around(weight, far)
    typical = [_around(weight * share, far) / total for share in shares[3:]]
    own = excess.clamp_min(0.0)
    return [
        0.2 * (bright + 0.1).log(),
        0.2 * ((bright + 0.3) / (level + 0.3)).log(),
        *(0.3 * ((bright + 0.2) / (one + 0.2)).log() for one in most),
        0.3 * ((own + 1.0) / (most[1] + 1.0)).log(),
        *shares,
        *(share - one for share, one in zip(shares[3:], typical, strict=True)),
    ]


def _parts(above: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Excess within the nearer and the farther of `_REACHES` around the peak, and after the farther, `[B, H, W]`."""
    bins, radius = above.shape[-1], response.shape[-1] // 2
    offset = torch.arange(-radius, radius + 1, device=above.device)
    deviation = (response * offset.square()).sum(dim=1).clamp_min(0.25).sqrt()[:, None, None]
    cumulative, centre = above.cumsum(dim=-1), place * bins
    edges = [centre + sign * (reach * deviation + 0.5) for reach in _REACHES for sign in (-1.0, 1.0)]
    first, last, start, stop = _counts_before(cumulative, torch.stack(edges, dim=-1)).unbind(dim=-1)
    return [last - first, stop - start, cumulative[..., -1] - stop]


def _brightest(image: Tensor, reach: int) -> Tensor:
    """The highest value up to `reach` pixels away in rows and columns."""
    side = 2 * reach + 1
    highest = F.max_pool2d(image[:, None], (side, 1), 1, (reach, 0))
    return F.max_pool2d(highest, (1, side), 1, (0, reach))[:, 0]


def _around(image: Tensor, side: int) -> Tensor:
    return pooled(image[..., None], side)[..., 0]


def _counts_before(cumulative: Tensor, place: Tensor) -> Tensor:
    """Of cumulative counts, those before places `[B, H, W, E]` [bins]."""
    bins = cumulative.shape[-1]
    cumulative = F.pad(cumulative, (1, 0)).expand(*place.shape[:-1], bins + 1)
    place = place.clamp(0.0, float(bins))
    below = place.long().clamp(max=bins - 1)
    return torch.lerp(cumulative.gather(-1, below), cumulative.gather(-1, below + 1), place - below)
