"""Loss of a training: the error of depth, and of the network's other answers."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.context import ANSWERS
from spadwarp.denoise.frames import POOLED
from spadwarp.denoise.pyramid import CLOSE
from spadwarp.denoise.selection import CHOICES
from spadwarp.denoise.synthetic_noise import Batch

__all__ = ["loss_of"]

_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_FINE_FLOOR = 1e-7  # the same for histograms, whose many photons give finer depths
_WATER = 0.001  # weight of depth where nothing is hit
_TARGET, _OTHERS = 0.3, 0.04  # weights of the cross-entropies of "sees a target" and of the other two logits
_NEAR = 0.015  # part of the gate within which a reported depth counts as the target's
_CHOICE = 0.005  # weight of the cross-entropy of the wide view's depths with those next to the truth
_TYPICAL = 1.5  # depths count as next to the truth within this times the median error of the answer before
_LEAST = 5e-4  # or within this [gate widths]


def loss_of(output: Tensor, batch: Batch, *, kind: str) -> Tensor:
    """Error of depth where a target is seen, and of the network's other outputs; a scalar.

    Where nothing is hit the true depth is 1, the end of the gate, with a thousandth of the weight. Crops without a
    target do not count for depth: the network would learn to answer 1 for targets that it can hardly see.
    """
    depth, logits, chosen, learnt = output.tensor_split([1, 4, 4 + 2 + POOLED], dim=1)
    weight = _WATER + (1.0 - _WATER) * batch.hit
    floor = _FINE_FLOOR if chosen.shape[1] else _FLOOR

    def error_of(square: Tensor) -> Tensor:
        return _depth_error(square, batch.hit, weight, kind, floor)

    error = error_of((depth - batch.clean).square())
    if logits.shape[1]:
        reported = chosen[:, :1].detach() if chosen.shape[1] else batch.frame[:, :1]
        right = batch.hit * ((depth.detach() - batch.clean).abs() < CLOSE)
        true = batch.hit * ((reported - batch.clean).abs() < _NEAR)
        error = error + _TARGET * _target_error(logits[:, :1], batch)
        for part, truth in ((logits[:, 1:2], right), (logits[:, 2:], true)):
            error = error + _OTHERS * F.binary_cross_entropy_with_logits(part, truth)
    if chosen.shape[1]:  # the candidates' errors, so that one is chosen and not a mean of several
        candidates = torch.cat([batch.frame[:, :1], 0.5 + batch.frame[:, 3 : 3 + POOLED]], dim=1)
        square = (candidates - batch.clean).square() * torch.softmax(chosen[:, 1:], dim=1)
        error = error + 0.5 * error_of(square.sum(dim=1, keepdim=True))
    if learnt.shape[1]:  # the same of the selection, and the wide view; neither changes what is before it
        candidates, scores, depths, weights, last, target = learnt.split([CHOICES] * 2 + [ANSWERS] * 2 + [1, 1], dim=1)
        square = (candidates - batch.clean).square() * torch.softmax(scores, dim=1)
        error = error + 0.5 * error_of(square.sum(dim=1, keepdim=True))
        error = error + error_of((last - batch.clean).square()) + _CHOICE * _choice_error(depths, weights, batch)
        error = error + _TARGET * _target_error(target, batch)
    return error


def _depth_error(square: Tensor, hit: Tensor, weight: Tensor, kind: str, floor: float) -> Tensor:
    """Mean over crops of their mean square, or of its logarithm."""
    mean = (weight * square).flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = mean if kind == "mse" else 0.1 * torch.log(mean + floor)
    return _mean_with_target(error, hit)


def _mean_with_target(error: Tensor, hit: Tensor) -> Tensor:
    """Mean over the crops that have a target."""
    with_target = (hit.flatten(1).mean(dim=1) > 0.005).float()
    return (with_target * error).sum() / with_target.sum().clamp_min(1.0)


def _target_error(logit: Tensor, batch: Batch) -> Tensor:
    """Cross-entropy of "sees a target", of the crops that count for it."""
    entropy = F.binary_cross_entropy_with_logits(logit, batch.hit, reduction="none")
    return (entropy * batch.judged).mean()


def _choice_error(depths: Tensor, scores: Tensor, batch: Batch) -> Tensor:
    """Cross-entropy of the scores with the depths next to the truth; the first depth is the answer before."""
    away = (depths.detach() - batch.clean).abs()
    typical = torch.where(batch.hit > 0, away[:, :1], torch.nan).flatten(1).nanmedian(dim=1).values.nan_to_num(0.01)
    near = (_TYPICAL * typical).clamp_min(_LEAST)[:, None, None, None]
    share = torch.softmax((-0.5 * (away / near).square()).clamp_min(-1e4), dim=1)
    entropy = -(share * scores.log_softmax(dim=1)).sum(dim=1, keepdim=True) * batch.hit
    return _mean_with_target(entropy.flatten(1).sum(dim=1) / batch.hit.flatten(1).sum(dim=1).clamp_min(1.0), batch.hit)
