"""Results for other libraries: torch tensors that share their memory (see `spadwarp.arrays`), and xarray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np

from spadwarp.arrays import Variable, is_torch, labelled
from spadwarp.result.result import ARRAYS, Component, Result, coordinates_of
from spadwarp.result.tallies import flux_arrays
from spadwarp.scene import Scene
from spadwarp.values import ArgumentError, check_choice

if TYPE_CHECKING:
    import torch
    import xarray

__all__ = ["TorchResult", "to_torch", "to_xarray"]

Frames = TypeVar("Frames")


@dataclass(frozen=True, eq=False, kw_only=True)
class TorchResult:
    """A `Result` for torch; `spadwarp.detect` takes it as it takes a `Result`. Methods as of `Result`, of float64."""

    scene: Scene  # as in `Result`, as unit and photons
    tallies: torch.Tensor  # int64 `[3, H, W, T]`, value = tally · `tally_value`
    unit: float
    photons: int
    tally_value: torch.Tensor  # fraction of the photons per tally unit, float64 `[H, W]`; see `Result.tally_value`
    truth: SimpleNamespace  # the maps of `Truth` as float32 tensors on the device of the tallies

    @cached_property
    def histogram(self) -> torch.Tensor:
        """`[H, W, T]`."""
        return self.tallies.sum(dim=0) * self.tally_value[..., None]

    def component(self, name: Component) -> torch.Tensor:
        """`[H, W, T]`."""
        names = self.scene.components
        chosen = names.index(check_choice("component", name, names))
        return self.tallies[chosen] * self.tally_value[..., None]

    @property
    def detections(self) -> torch.Tensor:
        """`[H, W, T]`."""
        return self.histogram * self.scene.detectable_photons_per_pulse

    @property
    def intensity(self) -> torch.Tensor:
        """`[H, W]`."""
        return self.histogram.sum(dim=-1)


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
            tallies are then not read.

    Returns `TorchResult`, or `Frames` whose arrays are tensors. Raises `ArgumentError`: the tensor is not int64 or has
    not as many elements as the result.
    """
    import torch

    if not isinstance(source, Result):
        names = ("counts", "expected", "background")
        return replace(source, **{name: _shared(getattr(source, name)) for name in names})
    tallies = _shared(source.tallies) if tallies is None else tallies
    shape = source.tallies.shape
    if tallies.dtype != torch.int64 or tallies.numel() != source.tallies.size:
        raise ArgumentError(f"tallies are {tallies.dtype} {tuple(tallies.shape)}; torch.int64 {shape} is needed")
    maps = {name: _shared(array).to(tallies.device) for name, array in vars(source.truth).items()}
    return TorchResult(
        scene=source.scene,
        tallies=tallies.view(shape),
        unit=source.unit,
        photons=source.photons,
        tally_value=_shared(source.tally_value).to(tallies.device),
        truth=SimpleNamespace(**maps),
    )


def _shared(array: Any) -> torch.Tensor:
    import torch

    if is_torch(array):
        return array
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def to_xarray(result: Result) -> xarray.Dataset:
    """Histograms by component, and truth, as an xarray data set with coordinates and units.

    `histogram` has the dimensions (component, y, x, time); `.sum("component")` is all light, `.sel(component=
    "backscatter")` a part of it. Coordinates: time of flight [s] at the bins' centres, `path` [m] along it, pixels.
    `derivative`, of results that have some, has the dimension parameter before these, and `polarisation`, or
    `other_wavelengths`, the dimension channel. Sections of flux are such as `around_fluence`, with dimensions of their
    own.
    Attributes: photons, seed, partial and the scene as TOML.

    Raises `FileError`: xarray is not installed.
    """
    cube = ("component", "y", "x", "time")
    values = np.stack([result.component(name) for name in result.scene.components])
    variables: dict[str, Variable] = {
        "histogram": (cube, values, "1", "expected fraction of the emitted photons per pixel and bin"),
        "detections_per_photon": ((), result.scene.detections_per_photon, "1", "detection efficiency with the filter"),
    }
    for name, array in vars(result.truth).items():
        variables[name] = (ARRAYS[f"truth/{name}"][1], array, *ARRAYS[f"truth/{name}"][2:])
    if result.batches > 1:
        variables["standard_error"] = (cube[1:], result.standard_error, "1", "of the histogram of all light")
    if result.derivatives:
        slopes = np.stack([*result.derivatives.values()])
        variables["derivative"] = (("parameter", *cube), slopes, "1", "of the histogram, per unit of the parameter")
    if result.channels:
        channels = np.stack([*result.channels.values()])
        name = "polarisation" if result.scene.camera.channels else "other_wavelengths"
        variables[name] = (("channel", *cube), channels, "1", "fraction of the emitted photons in a channel")
    known = coordinates_of(result)
    for name, array in flux_arrays(result.scene).items():
        section, _, kind = name.partition("/")
        axes = {f"{section}_{axis}": coordinate for axis, coordinate in array.dimensions.items()}
        light = result.flux[section][kind]
        variables[f"{section}_{kind}"] = (tuple(axes), light.values, array.unit, array.meaning)
        if light.errors is not None:
            variables[f"{section}_{kind}_error"] = (tuple(axes), light.errors, array.unit, "standard error")
        known |= axes
    known["channel"] = (list(result.channels), *known["channel"][1:])
    used = {dimension for dimensions, *_ in variables.values() for dimension in dimensions}
    coordinates: dict[str, Variable] = {name: ((name,), *known[name]) for name in known if name in used}
    path = result.bin_centres * result.pulse_speed
    coordinates["path"] = (("time",), path, "m", "geometric path, laser to target to lens")
    attributes = {
        "photons": result.photons,
        "photons_per_pulse": result.scene.laser.photons_per_pulse,
        "group_index": result.scene.medium.group_index,
        "seed": str(result.seed),
        "partial": int(result.partial),
        "scene": result.scene.to_toml(),
    }
    return labelled(variables, coordinates, attributes)
