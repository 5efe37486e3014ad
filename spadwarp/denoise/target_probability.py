"""What the search for the gate of the target knows of where a target is seen, and PyramidNet does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["corrected_target"]

_WATER = -2.2  # logits below it, and above 0, are sure enough to count how pixels of water, and of the target, report
_PRIOR = 30.0  # pixels of the target whose reports are assumed to be as those of the water
_LARGEST = 3.0  # correction of a logit


def corrected_target(logit: Tensor, depth: Tensor, reported: Tensor, share: Tensor) -> Tensor:
    """Logit of "sees a target", corrected by what the network is not given, `[N, H, W]`.

    The network sees the part of the gate that holds the target. It cannot tell pixels that reported nothing, which are
    mostly water, from those that reported backscatter outside that part. How often pixels of the target, and of the
    water, do one or the other is counted in the frame where the network is sure, and Bayes' rule does the rest. Nor
    does it see the whole of a large frame: where few pixels report and their depths agree no more often than those of
    backscatter, a target can take only a small part of the frame, and its pixels are as much less probable.

    Args:
        logit: Of the network, `[N, H, W]`.
        depth: NaN where nothing was reported, `[N, H, W]`.
        reported: Which pixels reported a depth that the network was given, 1 or 0, `[N, H, W]`.
        share: The largest part of the frame that a target can take, of `gates_of_target`, `[N]`.
    """
    import torch

    absent = depth.isnan()
    beyond = (reported < 0.5) & ~absent

    def counts(chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Chosen pixels without a report, and with one outside that part of the gate, each `[N]`."""
        return (chosen & absent).flatten(1).sum(1), (chosen & beyond).flatten(1).sum(1)

    none, some = counts(logit < _WATER)
    water = (none + 0.5) / (none + some + 1.0)
    none, some = counts(logit > 0.0)
    target = (none + _PRIOR * water) / (none + some + _PRIOR)
    of_absent, of_beyond = (
        ratio.log().clamp(-_LARGEST, _LARGEST)[:, None, None]
        for ratio in (target / water, (1.0 - target) / (1.0 - water))
    )
    logit = logit + torch.where(absent, of_absent, torch.where(beyond, of_beyond, 0.0))
    return logit + share.log().clamp_min(-_LARGEST)[:, None, None]
