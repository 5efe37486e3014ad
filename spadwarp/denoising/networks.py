"""The networks: USDN, DnCNN, and PyramidNet, which knows the water's backscatter.

All take `[batch, 3, height, width]`: depth over the gate (0 at its start, 1 at its end; 1 where nothing was reported),
1 where the pixel reported something, and the logarithm of the backscatter's density at the reported depth (0 for a flat
profile, see `spadwarp.denoising.noise.log_density`). They return denoised depth over the gate, `[batch, 1, height,
width]`; PyramidNet also the logits of "this pixel sees a target" and of "its depth is the target's".
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["NETWORKS", "USDN", "DnCNN", "PyramidNet", "build_network", "multiply_adds"]


class USDN(nn.Module):
    """DehazeNet made fully convolutional: 5×5 convolution, maxout, three scales, 7×7 maximum, one map, bounded ReLU.

    After Cai et al., IEEE TIP 25, 5187 (2016), as the paper describes its denoiser; its 8 240 weights belong to three
    input channels, of which depth has one. Sees depth alone.
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
        return x + self.second(F.relu(self.first(F.relu(x))))


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(_Residual(channels) for _ in range(count)))


class PyramidNet(nn.Module):
    """Weighted means of depths that come from the target, with weights from a pyramid of features.

    A pixel's depth is a convex combination of the 5×5 depths about it, of the mean depths of 3×3 blocks of 4 and of 16
    pixels about it, and of one value of the network's own. The weight of a depth is the product of what the place it
    came from says (the probability that it is the target's) and of what the place it goes to says (whether the two
    belong together). Depths of signal photons are thereby used as they are, to the millimetre; where there are none,
    the network's own value stands. Kernel prediction: Bako et al., ACM TOG 36, 97 (2017); means weighted by certainty:
    Knutsson & Westin, CVPR 1993.

    What it knows beyond depth: which pixels reported, how probable backscatter is at the reported depth, and three
    order statistics of each 3×3 neighbourhood, which shut out the nearer, scattered photons. The pyramid works on 2×2
    blocks (a quarter of the pixels), then on 4, 8 and 16 pixels.
    """

    radius = 2
    ranks = (2, 4, 6)  # of nine sorted depths
    blocks = (4, 16)  # sides of the coarse candidates
    stride = 16  # sizes are padded to multiples of it

    def __init__(self, *, widths: tuple[int, int, int, int] = (40, 64, 80, 96)) -> None:
        super().__init__()
        one, two, three, four = widths
        self.enter = nn.Conv2d(4 * (3 + len(self.ranks)), one, 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(wide, deep, 2, stride=2) for wide, deep in ((one, two), (two, three), (three, four))
        )
        self.up = nn.ModuleList(
            nn.Conv2d(deep, 4 * wide, 1) for wide, deep in ((one, two), (two, three), (three, four))
        )
        self.before = nn.ModuleList(_blocks(wide, count) for wide, count in zip(widths, (1, 1, 1, 2), strict=True))
        self.after = nn.ModuleList(_blocks(wide, count) for wide, count in zip(widths, (2, 1, 1), strict=False))
        near = (2 * self.radius + 1) ** 2
        self.candidates = near + 9 * len(self.blocks)
        # For each of the 4 pixels of a block: weights of the candidates and of the own value, the own value, the
        # logits of "this pixel sees a target" and of "this depth is the target's".
        self.leave = nn.Conv2d(one, 4 * (self.candidates + 4), 1)
        with torch.no_grad():  # begins near the identity
            assert self.leave.bias is not None
            bias = torch.zeros(self.candidates + 4)
            bias[near // 2], bias[near : self.candidates], bias[self.candidates] = 3.0, -2.0, -2.0
            bias[self.candidates + 2 :] = 2.0
            self.leave.weight.mul_(0.3)
            self.leave.bias.copy_(bias.repeat_interleave(4))

    def forward(self, frame: Tensor) -> Tensor:
        """Three channels: depth, and the logits of "sees a target" and of "the reported depth is the target's"."""
        height, width = frame.shape[-2:]
        bottom, right = -height % self.stride, -width % self.stride
        if bottom or right:
            frame = F.pad(frame, (0, right, 0, bottom), mode="replicate")
        depth, reported, density = frame[:, :1], frame[:, 1:2], frame[:, 2:3]
        ranked = [rank - depth for rank in _ranks(depth, self.ranks)]
        inputs = torch.cat([depth - 0.5, reported, 0.25 * density, *ranked], dim=1)
        x = self.before[0](self.enter(F.pixel_unshuffle(inputs, 2)))
        skipped = []
        for down, before in zip(self.down, list(self.before)[1:], strict=True):
            skipped.append(x)
            x = before(down(x))
        for level in (2, 1, 0):
            x = self.after[level](skipped[level] + F.pixel_shuffle(self.up[level](x), 2))
        head = F.pixel_shuffle(self.leave(F.relu(x)), 2).float().permute(0, 2, 3, 1)  # candidates side by side
        weights = head[..., : self.candidates + 1]
        own, seen, true = head[..., self.candidates + 1 :].permute(0, 3, 1, 2).split(1, dim=1)

        depth, reported = depth.float(), reported.float()
        certainty = torch.sigmoid(true) * reported
        values = [_windows(depth, self.radius)]
        trusts = [_windows(F.logsigmoid(true) + 1e4 * (reported - 1.0), self.radius)]
        for side in self.blocks:
            share = F.avg_pool2d(certainty, side)
            mean = F.avg_pool2d(certainty * depth, side) / (share + 1e-6)
            values.append(_enlarged(_windows(mean, 1), side))
            trusts.append(_enlarged(_windows(torch.log(share + 1e-6), 1), side))
        values.append(0.5 + own.permute(0, 2, 3, 1))
        trusts.append(torch.zeros_like(values[-1]))
        shares = (weights + torch.cat(trusts, dim=-1)).softmax(dim=-1)
        found = (shares * torch.cat(values, dim=-1)).sum(dim=-1)[:, None]
        return torch.cat([found, seen, true], dim=1)[..., :height, :width]


def _ranks(depth: Tensor, ranks: tuple[int, ...]) -> list[Tensor]:
    """Order statistics of each 3×3 neighbourhood by a sorting network of 25 exchanges (Floyd)."""
    values = [one[..., 0][:, None] for one in _windows(depth, 1).split(1, dim=-1)]
    for i, j in _SORT_NINE:
        values[i], values[j] = torch.minimum(values[i], values[j]), torch.maximum(values[i], values[j])
    return [values[rank] for rank in ranks]


_SORT_NINE = (
    (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (0, 3), (3, 6), (0, 3), (1, 4), (4, 7),
    (1, 4), (2, 5), (5, 8), (2, 5), (1, 3), (5, 7), (2, 6), (4, 6), (2, 4), (2, 3), (5, 6),
)  # fmt: skip


def _windows(image: Tensor, radius: int) -> Tensor:
    """`[B, 1, H, W]` to `[B, H, W, (2 radius + 1)²]`: windows, row by row, beyond the border too."""
    size = 2 * radius + 1
    padded = F.pad(image, (radius, radius, radius, radius), mode="replicate")[:, 0]
    return padded.unfold(1, size, 1).unfold(2, size, 1).flatten(3)


def _enlarged(image: Tensor, side: int) -> Tensor:
    """`[B, H, W, C]` with every pixel repeated `side` times along rows and columns."""
    batch, height, width, channels = image.shape
    wide = image[:, :, None, :, None].expand(batch, height, side, width, side, channels)
    return wide.reshape(batch, height * side, width * side, channels)


NETWORKS: dict[str, Callable[[], nn.Module]] = {"usdn": USDN, "dncnn": DnCNN, "pyramid": PyramidNet}
"""Networks by the name that recipes and commands use."""


def build_network(name: str) -> nn.Module:
    """A network with new weights; raises ValueError for a name that is not in `NETWORKS`."""
    if name not in NETWORKS:
        raise ValueError(f"model = {name!r} is not one of {', '.join(map(repr, NETWORKS))}")
    return NETWORKS[name]()


def multiply_adds(network: nn.Module, height: int, width: int) -> int:
    """Multiplications of all convolutions for one frame of `height` × `width`; what else there is costs little."""
    total = 0

    def count(layer: nn.Module, _: object, output: Tensor) -> None:
        nonlocal total
        assert isinstance(layer, nn.Conv2d)
        total += layer.weight[0].numel() * output[0].numel()

    hooks = [layer.register_forward_hook(count) for layer in network.modules() if isinstance(layer, nn.Conv2d)]
    mode = network.training
    try:
        with torch.inference_mode():
            network.eval()(torch.zeros(1, 3, height, width, device=next(network.parameters()).device))
    finally:
        network.train(mode)
        for hook in hooks:
            hook.remove()
    return total
