"""The networks: USDN, DnCNN, and PyramidNet, which also sees the water's backscatter.

All take `[batch, 3, height, width]`: depth over the gate (0 at its start, 1 at its end; 1 where nothing was reported),
1 where the pixel reported something, and the logarithm of the backscatter's density at the reported depth (0 for a flat
profile, see `spadwarp.denoise.synthetic_noise.log_density`). PyramidNet for histograms also takes the channels of
`spadwarp.denoise.histogram_features`, with 0.5 subtracted from the depths among them. They return denoised depth over
the gate, `[batch, 1, height, width]`; PyramidNet also the logits of `spadwarp.denoise.pyramid.OUTPUTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.histogram_features import FEATURES
from spadwarp.denoise.pyramid import PyramidNet
from spadwarp.denoise.repeatable import edge_padded
from spadwarp.values import ArgumentError

__all__ = ["NETWORKS", "USDN", "DnCNN", "PyramidNet", "build_network", "multiply_adds", "reads_histograms"]


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
        depth = self.last(edge_padded(features, 3)[..., 1:, 1:])
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


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "usdn": USDN,
    "dncnn": DnCNN,
    "pyramid": PyramidNet,
    "histograms": partial(PyramidNet, widths=(4, 5, 8, 10, 12), fine=0, refines=False, votes=False, histograms=True),
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
