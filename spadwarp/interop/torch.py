"""torch: results and frames as tensors that share their memory, and tensors of the caller's to write into.

The rule of the interface: who hands in torch tensors is given torch tensors, on their device, in the order of the torch
stream that is current. Only this file knows torch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, cast, overload

import numpy as np

from spadwarp.result.result import COMPONENTS, Component, Result, Truth

if TYPE_CHECKING:
    import torch
    import warp as wp

    from spadwarp.frames.spad import Frames
    from spadwarp.scene import Scene

__all__ = [
    "TorchResult",
    "TorchTruth",
    "caller_tallies",
    "in_torch_order",
    "is_torch",
    "on_host",
    "output_tensor",
    "tensor_of",
    "to_torch",
]


class TorchTruth(NamedTuple):
    """`spadwarp.Truth` as tensors: `depth`, `range`, `reflectance` `[H, W]`, `normal` `[H, W, 3]`, float32."""

    depth: torch.Tensor
    range: torch.Tensor
    normal: torch.Tensor
    reflectance: torch.Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class TorchResult:
    """A `Result` for torch; `spadwarp.detect` takes it as it takes a `Result`.

    Attributes:
        scene, unit, photons: As in `Result`.
        tallies: int64 `[3, H, W, T]`, value = tally · `tally_value`.
        tally_value: Fraction of the photons per tally unit, float64 `[H, W]`; see `Result.tally_value`.
        truth: float32 maps on the device of the tallies.
    """

    scene: Scene
    tallies: torch.Tensor
    unit: float
    photons: int
    tally_value: torch.Tensor
    truth: TorchTruth

    @cached_property
    def histogram(self) -> torch.Tensor:
        """Expected fraction of emitted photons that arrive in each pixel and bin, float64 `[H, W, T]`."""
        return self._fraction(self.tallies.sum(dim=0))

    def component(self, name: Component) -> torch.Tensor:
        """One part of the histogram, float64 `[H, W, T]`; see `Result.component`."""
        if name not in COMPONENTS:
            raise ValueError(f"component {name!r} is not one of {', '.join(map(repr, COMPONENTS))}")
        return self._fraction(self.tallies[COMPONENTS.index(name)])

    @property
    def detections(self) -> torch.Tensor:
        """Expected detections per pulse, float64 `[H, W, T]`: histogram · photons per pulse · PDE."""
        return self.histogram * (self.scene.laser.photons_per_pulse * self.scene.detector.pde)

    @property
    def intensity(self) -> torch.Tensor:
        """Expected fraction of emitted photons that arrive in each pixel within the gate, float64 `[H, W]`."""
        return self.histogram.sum(dim=-1)

    def _fraction(self, tallies: torch.Tensor) -> torch.Tensor:
        return tallies.double() * self.tally_value.unsqueeze(-1)


@overload
def to_torch(source: Result, *, tallies: torch.Tensor | None = None) -> TorchResult: ...
@overload
def to_torch(source: Frames) -> Frames: ...
def to_torch(source: Any, *, tallies: torch.Tensor | None = None) -> Any:
    """A result or frames for torch, without copying what is large.

    Args:
        source: A `Result`: its tallies become a tensor on the CPU that shares their memory. `Frames`: the same
            with `counts`, `expected` and `background` as tensors.
        tallies: The caller's tensor that `spadwarp.simulate(…, tallies=…)` has filled, on any device; the result's
            tallies are then not looked at.

    Returns:
        `TorchResult`, or `Frames` whose arrays are tensors.

    Raises:
        ValueError: The tensor is not int64 or has not as many elements as the result.
    """
    import torch

    if not isinstance(source, Result):
        return replace(
            source, **{name: _shared(getattr(source, name)) for name in ("counts", "expected", "background")}
        )
    if tallies is None:
        tallies = _shared(source.tallies)
    shape = source.tallies.shape
    if tallies.dtype != torch.int64 or tallies.numel() != source.tallies.size:
        raise ValueError(f"tallies are {tallies.dtype} {tuple(tallies.shape)}; torch.int64 {shape} is needed")
    maps = {name: _shared(getattr(source.truth, name)).to(tallies.device) for name in Truth.__dataclass_fields__}
    return TorchResult(
        scene=source.scene,
        tallies=tallies.view(shape),
        unit=source.unit,
        photons=source.photons,
        tally_value=_shared(source.tally_value).to(tallies.device),
        truth=TorchTruth(**maps),
    )


def _shared(array: Any) -> torch.Tensor:
    import torch

    if is_torch(array):
        return array
    return torch.from_numpy(array if array.flags.writeable else array.copy())


# For the functions that take arrays of any kind


def on_host(array: Any) -> Any:
    """A tensor as a NumPy array, copied only from a GPU; anything else as it is."""
    return array.detach().cpu().numpy() if is_torch(array) else array


def is_torch(array: Any) -> bool:
    """Whether it is a tensor, found out without loading torch."""
    return type(array).__module__.partition(".")[0] == "torch"


@contextmanager
def in_torch_order(*arrays: Any) -> Iterator[None]:
    """Warp's work of the block goes to the torch stream that is current on the device of the first tensor on CUDA.

    Warp's own stream waits for it afterwards: on that one it frees what the block has allocated. What the block hands
    to the caller has to be torch's memory, which other streams may still read when it is freed (`tensor_of`).
    """
    place = next((array.device for array in arrays if is_torch(array) and array.is_cuda), None)
    if place is None:
        yield
        return
    import torch
    import warp as wp

    from spadwarp.device import start_warp

    start_warp()
    stream = wp.stream_from_torch(torch.cuda.current_stream(place))
    with wp.ScopedStream(stream, sync_enter=True, sync_exit=True):
        yield


def tensor_of(array: wp.array) -> torch.Tensor:
    """A copy in torch's memory on the array's device, inside `in_torch_order`.

    A copy, since an array of Warp's may be freed before other streams have read it.
    """
    import torch
    import warp as wp

    tensor = torch.empty(array.shape, dtype=wp.dtype_to_torch(array.dtype), device=wp.device_to_torch(array.device))
    wp.copy(cast(wp.array, wp.from_torch(tensor)), array)
    return tensor


def output_tensor(out: Any, *, name: str, shape: Sequence[int], device: wp.Device) -> torch.Tensor:
    """The caller's int32 tensor for an output, or a new one, inside `in_torch_order`.

    Raises:
        ValueError: It is not a tensor, of another type or shape, not contiguous, or on another device.
    """
    import torch
    import warp as wp

    place, shape = torch.device(wp.device_to_torch(device)), tuple(shape)
    if out is None:
        return torch.empty(shape, dtype=torch.int32, device=place)
    if not is_torch(out):
        raise ValueError(f"{name} is a {type(out).__name__}; a torch tensor is needed")
    if out.dtype != torch.int32 or out.shape != shape or not out.is_contiguous() or out.device != place:
        raise ValueError(
            f"{name} is {out.dtype} {tuple(out.shape)} on {out.device}; contiguous torch.int32 {shape} on {place} is "
            "needed"
        )
    return out


def caller_tallies(tallies: Any, *, shape: Sequence[int], device: wp.Device) -> wp.array:
    """The caller's own tensor or Warp array as zeroed tallies, flat.

    Raises:
        ValueError: It is of another kind, type or size, not contiguous, or on another device.
    """
    import warp as wp

    if not (is_torch(tallies) or isinstance(tallies, wp.array)):
        raise ValueError(f"tallies are a {type(tallies).__name__}; a torch tensor or a Warp array is needed")
    array: Any = wp.from_torch(tallies, requires_grad=False) if is_torch(tallies) else tallies
    size = int(np.prod(shape))
    if array.dtype is not wp.int64 or array.size != size or not array.is_contiguous or array.device != device:
        raise ValueError(
            f"tallies are {array.dtype.__name__} {tuple(array.shape)} on {array.device}; contiguous int64 "
            f"{tuple(shape)} on {device} is needed"
        )
    with in_torch_order(tallies):
        array.zero_()
    return array.reshape((size,))
