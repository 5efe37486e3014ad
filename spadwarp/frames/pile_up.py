"""Pile-up of first-photon counting: its law, and Coates' correction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import histogram_rows, in_torch_order, is_torch, tensor_of
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_integer

__all__ = ["coates", "first_photon_probabilities"]


def first_photon_probabilities(hazard: Any, *, device: Any = None) -> NDArray[np.float64]:
    """Law of first-photon counting, with pile-up: P(k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)); same shape as `hazard` (λ).

    Args:
        hazard: Expected detections per pulse and bin `[..., T]`, not negative; NumPy, torch or Warp.
        device: Warp device; default: where the array lies, for NumPy the first GPU or else the CPU.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(hazard):
        rows, shape = histogram_rows(hazard, name="hazard", device=device)
        if rows.dtype not in (wp.float32, wp.float64):
            rows = wp.array(rows.numpy().astype(np.float64), device=rows.device)
        law = kernels.first_photon_probabilities(rows)
        found: Any = tensor_of(law).double() if is_torch(hazard) else law.numpy().astype(np.float64)
    return found.reshape(shape)


def coates(counts: Any, *, pulses: int, device: Any = None) -> NDArray[np.float64]:
    """Coates' correction of first-photon counts: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), same shape as `counts`.

    NaN from the bin on that takes the last pulse. Source: P. B. Coates, J. Phys. E 1, 878 (1968).

    Args:
        counts: Integers `[..., T]`, not negative; NumPy, torch or Warp.
        pulses: Pulses of each histogram, which may hold no more counts than that.
        device: Warp device; default: where the array lies, for NumPy the first GPU or else the CPU.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(counts):
        rows, shape = histogram_rows(counts, name="counts", device=device)
        if rows.dtype not in (wp.int32, wp.int64):
            raise ArgumentError(f"counts are {rows.dtype.__name__}; integers are needed")
        values = rows.numpy()
        if values.max() > 2**31 - 1:
            raise ArgumentError(f"counts = {values.max()} is above {2**31 - 1}")
        pulses = check_integer("pulses", pulses, "[1, 9007199254740992]")
        most = int(values.sum(axis=1, dtype=np.int64).max())
        if most > pulses:
            raise ArgumentError(
                f"pulses = {pulses} is below the {most} counts of a histogram: it has seen more than one a pulse"
            )
        if rows.dtype != wp.int32:
            rows = wp.array(values.astype(np.int32), dtype=wp.int32, device=rows.device)
        corrected = kernels.coates(rows, pulses=pulses)
        found: Any = tensor_of(corrected) if is_torch(counts) else corrected.numpy()
    return found.reshape(shape)
