"""Tallies with a sign beside a result's histogram: its derivatives, and channels of a receiver of polarised light."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, ConfigError, SpadwarpError

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["SignedTallies", "channel_values", "check_signed", "derivative_values", "short_names"]


@dataclass(frozen=True, eq=False)
class SignedTallies:
    """Tallies of the derivatives of a histogram, or of channels.

    Attributes:
        names: Of the P parameters, such as "medium.absorption", or channels, such as "cross".
        tallies: int64 `[P, 3, H, W, T]`, by component; derivative or channel = tally · unit / photons.
        units: Fraction of one emitted photon, per unit of the parameter, that a tally unit stands for; powers of two.
        second_moment: uint64 `[2, P, H, W, T]`, as `Result.second_moment`; None without batches.
    """

    names: tuple[str, ...]
    tallies: NDArray[np.int64]
    units: tuple[float, ...]
    second_moment: NDArray[np.uint64] | None = None

    def copy(self) -> SignedTallies:
        """With arrays of its own."""
        moments = None if self.second_moment is None else self.second_moment.copy()
        return replace(self, tallies=self.tallies.copy(), second_moment=moments)

    def add(self, other: SignedTallies) -> None:
        """Adds those of other photons. Raises `ConfigError` where they are of other parameters."""
        if (self.names, self.units) != (other.names, other.units):
            raise ConfigError(f"the results have tallies of {_listed(self.names)} and of {_listed(other.names)}")
        self.tallies[...] += other.tallies
        if np.abs(self.tallies.sum(axis=1, dtype=np.float64)).max(initial=0.0) >= 2.0**62:
            raise SpadwarpError(
                "a bin of a derivative or a channel overflowed; run fewer photons at a time and average the results"
            )
        if self.second_moment is not None and other.second_moment is not None:
            add_moments(self.second_moment, other.second_moment)


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "nothing"


def add_moments(total: NDArray[np.uint64], more: NDArray[np.uint64]) -> None:
    """Adds 128-bit integers in place; both [2, ...], low and high halves."""
    low, high = total
    low += more[0]
    high += more[1]
    high += low < more[0]  # the carry


def check_signed(result: Result, shape: tuple[int, ...]) -> None:
    """Raises `ArgumentError` where signed tallies of a result are not those of its scene, beside tallies of a shape."""
    channels = () if result.channel_tallies is None else result.channel_tallies.names
    expected = result.scene.camera.tallied_channels
    if channels != expected:
        raise ArgumentError(f"channel_tallies are of {channels}; {expected} are the camera's")
    for name in ("derivative_tallies", "channel_tallies"):
        found: SignedTallies | None = getattr(result, name)
        if found is not None:
            _check_arrays(name, found, shape, result.second_moment is not None)


def _check_arrays(name: str, found: SignedTallies, shape: tuple[int, ...], batches: bool) -> None:
    count = len(found.names)
    expected = (count, *shape)
    if found.tallies.dtype != np.int64 or found.tallies.shape != expected or len(found.units) != count:
        found_as = f"{found.tallies.dtype} {found.tallies.shape} with {len(found.units)} units"
        raise ArgumentError(f"{name} are {found_as}; int64 {expected} with {count} units are needed")
    moments = (2, count, *shape[1:])
    if (found.second_moment is not None) != batches:
        raise ArgumentError(f"{name} and tallies: both have a second moment, or none of them")
    if found.second_moment is not None and (found.second_moment.dtype, found.second_moment.shape) != (
        np.uint64,
        moments,
    ):
        raise ArgumentError(f"{name}.second_moment is not uint64 {moments}")


_BLOCK = re.compile(r"\[(\d+),(\d+),(\d+)\]")


class _Values(Mapping[str, NDArray[np.float64]]):
    """Name → array, made from integers when it is asked for; that of a derivative without its block stands for all of
    them, `[x, y, z, ...]`."""

    def __init__(
        self, kind: str, result: Result, found: SignedTallies | None, names: tuple[str, ...], errors: bool
    ) -> None:
        self._kind, self._result, self._found, self._names, self._errors = kind, result, found, names, errors

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        result, found = self._result, self._found
        if found is not None and (places := _places(found.names, name)):
            blocks = np.stack([self[f"{name}[{i},{j},{k}]"] for i, j, k in places])
            return blocks.reshape(*_shape(places), *blocks.shape[1:])
        if name not in self._names:
            raise KeyError(f"{name!r} is not one of the {self._kind}: {', '.join(self) or 'none were asked for'}")
        if found is None or name not in found.names:  # the intensity, which is the histogram
            return result.standard_error if self._errors else result.tallies * result.tally_value[..., None]
        p = found.names.index(name)
        value = (found.units[p] / result.unit * result.tally_value)[..., None]
        if not self._errors:
            return found.tallies[p] * value
        if found.second_moment is None or result.photons < 2 * result.batch_size:
            raise ConfigError("the result holds no batches; simulate with uncertainty=True and more photons")
        moments = found.second_moment[:, p]
        return standard_error(found.tallies[p], moments, result.photons // result.batch_size) * value

    def __repr__(self) -> str:
        return f"{{{', '.join(map(repr, self))}}}"


def _shape(places: list[tuple[int, int, int]]) -> list[int]:
    return [max(indices) + 1 for indices in zip(*places, strict=True)]


def short_names(names: tuple[str, ...]) -> list[str]:
    """For a reader: one text for all blocks, such as "medium.grid.absorption of 4 x 4 x 2 blocks"."""
    found = dict[str, str]()
    for name in names:
        whole = name.partition("[")[0]
        places = _places(names, whole)
        found[whole if places else name] = (
            f"{whole} of {' x '.join(map(str, _shape(places)))} blocks" if places else name
        )
    return list(found.values())


def _places(names: tuple[str, ...], name: str) -> list[tuple[int, int, int]]:
    """Of all blocks by whose coefficient `name` a histogram is differentiated."""
    behind = [_BLOCK.fullmatch(one.removeprefix(name)) for one in names if one.startswith(f"{name}[")]
    return [(int(match[1]), int(match[2]), int(match[3])) for match in behind if match is not None]


def derivative_values(result: Result, *, errors: bool = False) -> Mapping[str, NDArray[np.float64]]:
    """Parameter → float64 `[3, H, W, T]`, or standard error of the sum over components, `[H, W, T]`."""
    found = result.derivative_tallies
    return _Values("derivatives", result, found, () if found is None else found.names, errors)


def channel_values(result: Result, *, errors: bool = False) -> Mapping[str, NDArray[np.float64]]:
    """Channel of the receiver → as `derivative_values`."""
    return _Values("channels", result, result.channel_tallies, result.scene.camera.channels, errors)


def standard_error(tallies: NDArray[np.int64], second_moment: NDArray[np.uint64], batches: int) -> NDArray[np.float64]:
    """Of the sum over components of tallies `[3, ...]`, in their unit, from the spread between batches."""
    total = tallies.sum(axis=0).astype(np.float64)
    squares = second_moment[1] * 2.0**64 + second_moment[0]
    variance = np.maximum(squares - total**2 / batches, 0.0) / (batches - 1)
    return np.sqrt(batches * variance)
