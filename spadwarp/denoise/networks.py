"""The networks: USDN, DnCNN, and PyramidNet, which also sees the water's backscatter.

All take `[batch, 3, height, width]`: depth over the gate (0 at its start, 1 at its end; 1 where nothing was reported),
1 where the pixel reported something, and the logarithm of the backscatter's density at the reported depth (0 for a flat
profile, see `spadwarp.denoise.synthetic_noise.log_density`). PyramidNet for histograms also takes the channels of
`spadwarp.denoise.histogram_features`, with 0.5 subtracted from the depths among them. They return denoised depth over
the gate, `[batch, 1, height, width]`; PyramidNet also the logits of "this pixel sees a target" and of "its depth is the
target's".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.histogram_features import FEATURES, WINDOWS
from spadwarp.errors import ArgumentError

__all__ = ["NETWORKS", "USDN", "DnCNN", "PyramidNet", "build_network", "multiply_adds", "reads_histograms"]

LONGEST_DELAY = 0.2
"""Largest delay of forward-scattered light that the network can correct [gate widths]."""

_OLD_LAYERS = {"enter_clues.": "enter_features.", "leave_clues.": "leave_features."}  # of weights and checkpoints


class USDN(nn.Module):
    """DehazeNet made fully convolutional: 5×5 convolution, maxout, three scales, 7×7 maximum, one map, bounded ReLU.

    After Cai et al., IEEE TIP 25, 5187 (2016), as the paper describes its denoiser. DehazeNet's 8 240 weights are for
    three input channels; this network has one, depth.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, 16, 5, padding=2)
        self.scales = nn.ModuleList(nn.Conv2d(4, 16, size, padding=size // 2) for size in (3, 5, 7))
        self.last = nn.Conv2d(48, 1, 6)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        nn.init.constant_(self.last.bias, 0.5)  # type: ignore[arg-type]  # inside the bounds, where there is a slope

    def forward(self, frame: Tensor) -> Tensor:
        features = self.first(frame[:, :1]).unflatten(1, (4, 4)).amax(dim=2)
        features = torch.cat([scale(features) for scale in self.scales], dim=1)
        features = F.max_pool2d(features, 7, stride=1, padding=3)
        depth = self.last(F.pad(features, (2, 3, 2, 3), mode="replicate"))
        if not self.training:  # while it learns, values beyond the bounds must have a slope
            depth = depth.clamp(0.0, 1.0)
        return depth


class DnCNN(nn.Module):
    """Residual learning of the noise, 17 layers of 64 channels: Zhang et al., IEEE TIP 26, 3142 (2017); depth only."""

    def __init__(self, *, layers: int = 17, channels: int = 64) -> None:
        super().__init__()
        body: list[nn.Module] = [nn.Conv2d(1, channels, 3, padding=1), nn.ReLU(inplace=True)]
        for _ in range(layers - 2):
            body += [nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)]
            body.append(nn.ReLU(inplace=True))
        body.append(nn.Conv2d(channels, 1, 3, padding=1))
        self.body = nn.Sequential(*body)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight)

    def forward(self, frame: Tensor) -> Tensor:
        noise = self.body(frame[:, :1])
        return frame[:, :1] - noise.to(frame.dtype)


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)  # begins as the identity
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(F.relu(x)), inplace=True))


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(_Residual(channels) for _ in range(count)))


class PyramidNet(nn.Module):
    """Weighted means of depths that come from the target, with weights from a pyramid of features.

    A pixel's depth is a convex combination of the 5×5 depths around it, of the mean depths of 3×3 blocks of 4 and of 16
    pixels around it, and of one value of the network's own. The weight of a depth is the product of two factors: one
    belongs to the pixel that it comes from (the probability that it is the target's depth), the other to the pixel that
    it goes to (whether the two belong together). Depths of signal photons are thereby used as they are, to the
    millimetre; where there are none, the network's own value is used. Kernel prediction: Bako et al., ACM TOG 36, 97
    (2017); means weighted by certainty: Knutsson & Westin, CVPR 1993.

    Its inputs beyond depth: which pixels reported, how probable backscatter is at the reported depth, and three order
    statistics of each 3×3 neighbourhood, which leave out the scattered photons, whose depth is too small. The pyramid
    works on 2×2 blocks (a quarter of the pixels), then on 4, 8 and 16 pixels.

    With `histograms` it also sees the channels of `spadwarp.denoise.histogram_features`. Each pixel then first gets a
    depth from its own and those of pooled histograms, which replaces the reported one in all that follows; and the
    delay of scattered light, which the shape of the return shows, is subtracted from the result.
    """

    radius = 2
    ranks = 3  # third, fifth and seventh of nine sorted depths
    blocks = (4, 16)  # sides of the coarse candidates
    stride = 16  # sizes are padded to multiples of it

    def __init__(self, *, widths: tuple[int, int, int, int] = (40, 64, 80, 96), histograms: bool = False) -> None:
        super().__init__()
        finest, pairs = widths[0], list(pairwise(widths))
        self.enter = nn.Conv2d(4 * (3 + self.ranks), finest, 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(wide, deep, 2, stride=2) for wide, deep in pairs)
        self.up = nn.ModuleList(nn.Conv2d(deep, 4 * wide, 1) for wide, deep in pairs)
        self.before = nn.ModuleList(_blocks(wide, count) for wide, count in zip(widths, (1, 1, 1, 2), strict=True))
        self.after = nn.ModuleList(_blocks(wide, count) for wide, count in zip(widths, (2, 1, 1), strict=False))
        near = (2 * self.radius + 1) ** 2
        self.candidates = near + 9 * len(self.blocks)
        # For each of the 4 pixels of a block: weights of the candidates and of the own value, the own value, the
        # logits of "this pixel sees a target" and of "this depth is the target's".
        self.leave = _Planes(finest, 4 * (self.candidates + 4), 1)
        with torch.no_grad():  # begins near the identity
            assert self.leave.bias is not None
            bias = torch.zeros(self.candidates + 4)
            bias[near // 2], bias[near : self.candidates], bias[self.candidates] = 3.0, -2.0, -2.0
            bias[self.candidates + 2 :] = 2.0
            self.leave.weight.mul_(0.3)
            self.leave.bias.copy_(bias.repeat_interleave(4))
        self.enter_features: nn.Conv2d | None = None
        self.register_load_state_dict_pre_hook(_rename_old_layers)
        if histograms:
            self.enter_features = nn.Conv2d(4 * FEATURES, finest, 3, padding=1, bias=False)
            # For each of the 4 pixels of a block: logits of its own depth and of the pooled ones, and of the delay.
            self.leave_features = nn.Conv2d(finest, 4 * (len(WINDOWS) + 2), 1)
            with torch.no_grad():  # begins as the network without histograms
                assert self.leave_features.bias is not None
                self.enter_features.weight.mul_(0.1)
                self.leave_features.weight.mul_(0.3)
                self.leave_features.bias.copy_(torch.tensor([2.0, *[0.0] * (len(WINDOWS) + 1)]).repeat_interleave(4))

    def forward(self, frame: Tensor) -> Tensor:
        """Depth, the logits of "sees a target" and of "its depth is the target's"; with histograms also that depth."""
        height, width = frame.shape[-2:]
        bottom, right = -height % self.stride, -width % self.stride
        if bottom or right:
            frame = F.pad(frame, (0, right, 0, bottom), mode="replicate")
        depth, reported, density = (channel.contiguous() for channel in frame[:, :3].split(1, dim=1))
        ranked = [rank - depth for rank in _ranks(depth)]
        inputs = torch.cat([depth - 0.5, reported, 0.25 * density, *ranked], dim=1)
        x = self.enter(F.pixel_unshuffle(inputs, 2))
        if self.enter_features is not None:
            x = x + self.enter_features(F.pixel_unshuffle(frame[:, 3:], 2))
        x = self.before[0](x)
        skipped = []
        for down, before in zip(self.down, list(self.before)[1:], strict=True):
            skipped.append(x)
            x = before(down(x))
        for level in (2, 1, 0):
            x = self.after[level](skipped[level] + F.pixel_shuffle(self.up[level](x), 2))

        # From here on over the blocks, in planes of one candidate for one of a block's 2×2 pixels.
        head = self.leave(F.relu(x)).float().unflatten(1, (-1, 2, 2))
        depth, reported = depth.float(), reported.float()
        true = F.pixel_shuffle(head[:, -1].flatten(1, 2), 2)
        if self.enter_features is not None:
            depth, delay = self._chosen(depth, reported, frame[:, 3:].float(), self.leave_features(F.relu(x)))
            reported = torch.ones_like(depth)
        certainty = torch.sigmoid(true) * reported
        values = [_windows(depth, self.radius)]
        trusts = [_windows(F.logsigmoid(true) + 1e4 * (reported - 1.0), self.radius)]
        for side in self.blocks:
            share = F.avg_pool2d(certainty, side)
            values.append(_coarse_windows(F.avg_pool2d(certainty * depth, side) / (share + 1e-6), side))
            trusts.append(_coarse_windows(torch.log(share + 1e-6), side))
        weights = head[:, : self.candidates].split([value.shape[1] * value.shape[2] for value in values], dim=1)
        logits = [weight.unflatten(1, trust.shape[1:3]) + trust for weight, trust in zip(weights, trusts, strict=True)]
        own = head[:, self.candidates :, None]
        found = _weighted_mean([*logits, own[:, :1]], [*values, 0.5 + own[:, 1:2]])
        output = torch.cat([found[:, None], head[:, -2:]], dim=1)
        output = F.pixel_shuffle(output.flatten(1, 3), 2)
        if self.enter_features is not None:
            output = torch.cat([output[:, :1] - delay, output[:, 1:], depth], dim=1)
        return output[..., :height, :width]

    def _chosen(self, depth: Tensor, reported: Tensor, features: Tensor, head: Tensor) -> tuple[Tensor, Tensor]:
        """A depth for each pixel from its own and those of pooled histograms, and the delay of its light."""
        depths = torch.cat([depth, 0.5 + features[:, : len(WINDOWS)]], dim=1)
        head = F.pixel_shuffle(head, 2).float()
        logits = torch.cat([head[:, :1] + 1e4 * (reported - 1.0), head[:, 1:-1]], dim=1)
        chosen = (logits.softmax(dim=1) * depths).sum(dim=1, keepdim=True)
        return chosen, LONGEST_DELAY * torch.sigmoid(head[:, -1:] - 5.0)


def _rename_old_layers(module: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Gives layers the names of today in weights and checkpoints that have older ones."""
    for name in list(state):
        for old, new in _OLD_LAYERS.items():
            if name.startswith(prefix + old):
                state[prefix + new + name.removeprefix(prefix + old)] = state.pop(name)


class _Planes(nn.Conv2d):
    """1×1 convolution whose output lies in planes, whatever the memory format of its input."""

    def forward(self, x: Tensor) -> Tensor:
        assert self.bias is not None
        weight = self.weight.permute(0, 2, 3, 1).flatten(1)  # in this order for the layout of its gradient
        weight = weight.expand(len(x), -1, -1)
        return torch.bmm(weight, x.flatten(2)).add_(self.bias[:, None]).unflatten(2, x.shape[2:])


def _ranks(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The third, fifth and seventh of the nine sorted values of each 3×3 neighbourhood.

    Columns are sorted, then rows, after which columns are still so: what can be third is the second in size of two
    sorted pairs, and the fifth is the middle one of the diagonal (Paeth, Graphics Gems, 1990).
    """
    height, width = depth.shape[-2:]
    padded = F.pad(depth, (1, 1, 1, 1), mode="replicate")
    column = _sorted(*(padded[..., row : row + height, :] for row in range(3)))
    least, middle, most = (_sorted(*(line[..., first : first + width] for first in range(3))) for line in column)
    third = torch.minimum(torch.maximum(least[1], middle[0]), torch.minimum(least[2], most[0]))
    fifth = _sorted(least[2], middle[1], most[0])[1]
    seventh = torch.maximum(torch.minimum(middle[2], most[1]), torch.maximum(least[2], most[0]))
    return third, fifth, seventh


def _sorted(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a, b = torch.minimum(a, b), torch.maximum(a, b)
    b, c = torch.minimum(b, c), torch.maximum(b, c)
    return torch.minimum(a, b), torch.maximum(a, b), c


def _windows(image: Tensor, radius: int) -> Tensor:
    """`[B, 1, 2h, 2w]` to `[B, n, n, 2, 2, h, w]`, n = 2 radius + 1: windows around each pixel of 2×2 blocks."""
    size = 2 * radius + 1
    padded = F.pad(image, (radius, radius, radius, radius), mode="replicate")[:, 0]
    blocks = padded.unfold(1, size + 1, 2).unfold(2, size + 1, 2).permute(0, 3, 4, 1, 2).contiguous()
    return blocks.unfold(1, size, 1).unfold(2, size, 1).permute(0, 5, 6, 1, 2, 3, 4)  # overlapping views


def _coarse_windows(image: Tensor, side: int) -> Tensor:
    """`[B, 1, 2h / side, 2w / side]` to `[B, 3, 3, 2, 2, h, w]`: all pixels of a coarse one have the same window."""
    height, width = image.shape[-2:]
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    windows = torch.cat([padded[..., y : y + height, x : x + width] for y in range(3) for x in range(3)], dim=1)
    windows = F.interpolate(windows, scale_factor=side // 2).unflatten(1, (3, 3))
    return windows[:, :, :, None, None].expand(-1, -1, -1, 2, 2, -1, -1)


def _weighted_mean(logits: list[Tensor], values: list[Tensor]) -> Tensor:
    """Mean over the second and third dimension of all parts together, weighted by their softmax.

    The parts are not concatenated: memory access takes most of the time here.
    """
    highest = torch.stack([logit.detach().amax(dim=(1, 2)) for logit in logits]).amax(dim=0)[:, None, None]
    weights = [(logit - highest).exp_() for logit in logits]
    sums = [(weight * value).sum(dim=(1, 2)) for weight, value in zip(weights, values, strict=True)]
    return torch.stack(sums).sum(dim=0) / torch.stack([weight.sum(dim=(1, 2)) for weight in weights]).sum(dim=0)


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "usdn": USDN,
    "dncnn": DnCNN,
    "pyramid": PyramidNet,
    "histograms": partial(PyramidNet, histograms=True),
}
"""Networks by the name that recipes and commands use."""


def build_network(name: str) -> nn.Module:
    """A network with new weights; raises ArgumentError for a name that is not in `NETWORKS`."""
    if name not in NETWORKS:
        raise ArgumentError(f"model = {name!r} is not one of {', '.join(map(repr, NETWORKS))}")
    return NETWORKS[name]()


def reads_histograms(network: nn.Module) -> bool:
    """Whether this network needs the channels of `spadwarp.denoise.histogram_features`."""
    return getattr(network, "enter_features", None) is not None


def multiply_adds(network: nn.Module, height: int, width: int) -> int:
    """Multiplications of all convolutions for one frame of `height` × `width`; other operations cost little."""
    from torch.utils.flop_counter import FlopCounterMode

    channels = 3 + FEATURES * reads_histograms(network)
    frame = torch.zeros(1, channels, height, width, device=next(network.parameters()).device)
    mode = network.training
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network.eval()(frame)
    network.train(mode)
    return counter.get_total_flops() // 2
