"""Loss of a training: the error of depth, and of the network's other answers."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.frames import POOLED
from spadwarp.denoise.pyramid import CLOSE
from spadwarp.denoise.synthetic_noise import Batch

__all__ = ["loss_of"]

_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_FINE_FLOOR = 1e-7  # the same for histograms, whose many photons give finer depths
_WATER = 0.001  # weight of depth where nothing is hit
_TARGET, _OTHERS = 0.3, 0.04  # weights of the cross-entropies of "sees a target" and of the other two logits
_NEAR = 0.015  # part of the gate within which a reported depth counts as the target's


def loss_of(output: Tensor, batch: Batch, *, kind: str) -> Tensor:
    """Error of depth where a target is seen, and of the network's other outputs; a scalar.

    Where nothing is hit the true depth is 1, the end of the gate, with a thousandth of the weight. Crops without a
    target do not count for depth: the network would learn to answer 1 for targets that it can hardly see.
    """
    depth, logits, chosen = output[:, :1], output[:, 1:4], output[:, 4:]
    weight = _WATER + (1.0 - _WATER) * batch.hit
    floor = _FINE_FLOOR if chosen.shape[1] else _FLOOR
    error = _depth_error((depth - batch.clean).square(), batch.hit, weight, kind, floor)
    if logits.shape[1]:
        reported = chosen[:, :1].detach() if chosen.shape[1] else batch.frame[:, :1]
        right = batch.hit * ((depth.detach() - batch.clean).abs() < CLOSE)
        true = batch.hit * ((reported - batch.clean).abs() < _NEAR)
        wanted = (_TARGET, batch.hit), (_OTHERS, right), (_OTHERS, true)
        for part, (share, truth) in zip(logits.split(1, dim=1), wanted, strict=True):
            error = error + share * F.binary_cross_entropy_with_logits(part, truth)
    if chosen.shape[1]:  # the candidates' errors, so that one is chosen and not a mean of several
        candidates = torch.cat([batch.frame[:, :1], 0.5 + batch.frame[:, 3 : 3 + POOLED]], dim=1)
        square = (candidates - batch.clean).square() * torch.softmax(chosen[:, 1 : 2 + POOLED], dim=1)
        error = error + 0.5 * _depth_error(square.sum(dim=1, keepdim=True), batch.hit, weight, kind, floor)
    if chosen.shape[1] > 2 + POOLED:  # the same of the selection, which changes nothing before it
        candidates, scores = chosen[:, 2 + POOLED : -1].chunk(2, dim=1)
        error = error + _depth_error((chosen[:, -1:] - batch.clean).square(), batch.hit, weight, kind, floor)
        square = (candidates - batch.clean).square() * torch.softmax(scores, dim=1)
        error = error + 0.5 * _depth_error(square.sum(dim=1, keepdim=True), batch.hit, weight, kind, floor)
    return error


def _depth_error(square: Tensor, hit: Tensor, weight: Tensor, kind: str, floor: float) -> Tensor:
    """Mean over crops of their mean square, or of its logarithm."""
    mean = (weight * square).flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = mean if kind == "mse" else 0.1 * torch.log(mean + floor)
    with_target = (hit.flatten(1).mean(dim=1) > 0.005).float()
    return (with_target * error).sum() / with_target.sum().clamp_min(1.0)
