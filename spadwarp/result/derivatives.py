"""Derivatives of a result's histogram with respect to the water and the targets, in fixed point with a sign."""

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

__all__ = ["DerivativeTallies", "check_derivatives", "derivative_errors", "derivative_values", "short_names"]


@dataclass(frozen=True, eq=False)
class DerivativeTallies:
    """Tallies of the derivatives of a histogram.

    Attributes:
        names: Of the P parameters, such as "medium.absorption".
        tallies: int64 `[P, 3, H, W, T]`, by component; derivative = tally · unit / photons.
        units: Of each parameter's tallies: fraction of one emitted photon per unit of the parameter, a power of two.
        second_moment: uint64 `[2, P, H, W, T]`, as `Result.second_moment`; None without batches.
    """

    names: tuple[str, ...]
    tallies: NDArray[np.int64]
    units: tuple[float, ...]
    second_moment: NDArray[np.uint64] | None = None

    def copy(self) -> DerivativeTallies:
        """With arrays of its own."""
        moments = None if self.second_moment is None else self.second_moment.copy()
        return replace(self, tallies=self.tallies.copy(), second_moment=moments)

    def add(self, other: DerivativeTallies) -> None:
        """Adds those of other photons. Raises `ConfigError` where they are of other parameters."""
        if (self.names, self.units) != (other.names, other.units):
            raise ConfigError(f"the results have derivatives by {_listed(self.names)} and by {_listed(other.names)}")
        self.tallies[...] += other.tallies
        if np.abs(self.tallies.sum(axis=1, dtype=np.float64)).max(initial=0.0) >= 2.0**62:
            raise SpadwarpError("a bin of a derivative overflowed; run fewer photons at a time and average the results")
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


def check_derivatives(found: DerivativeTallies, shape: tuple[int, ...], batches: bool) -> None:
    """Raises `ArgumentError` where the arrays are not those of a result with tallies of a shape."""
    count = len(found.names)
    expected = (count, *shape)
    if found.tallies.dtype != np.int64 or found.tallies.shape != expected or len(found.units) != count:
        found_as = f"{found.tallies.dtype} {found.tallies.shape} with {len(found.units)} units"
        raise ArgumentError(f"derivative_tallies are {found_as}; int64 {expected} with {count} units are needed")
    moments = (2, count, *shape[1:])
    if (found.second_moment is not None) != batches:
        raise ArgumentError("derivative_tallies and tallies: both have a second moment, or none of them")
    if found.second_moment is not None and (found.second_moment.dtype, found.second_moment.shape) != (
        np.uint64,
        moments,
    ):
        raise ArgumentError(f"derivative_tallies.second_moment is not uint64 {moments}")


_BLOCK = re.compile(r"\[(\d+),(\d+),(\d+)\]")


class _Values(Mapping[str, NDArray[np.float64]]):
    """Parameter → array, made from integers when it is asked for; the name without a block stands for all of them,
    `[x, y, z, ...]`."""

    def __init__(self, result: Result, errors: bool) -> None:
        self._result, self._errors = result, errors

    def __iter__(self) -> Iterator[str]:
        found = self._result.derivative_tallies
        return iter(() if found is None else found.names)

    def __len__(self) -> int:
        found = self._result.derivative_tallies
        return 0 if found is None else len(found.names)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        result, found = self._result, self._result.derivative_tallies
        if found is not None and (places := _places(found.names, name)):
            blocks = np.stack([self[f"{name}[{i},{j},{k}]"] for i, j, k in places])
            return blocks.reshape(*_shape(places), *blocks.shape[1:])
        if found is None or name not in found.names:
            raise KeyError(f"{name!r} is not one of the derivatives: {', '.join(self) or 'none were asked for'}")
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


def derivative_values(result: Result) -> Mapping[str, NDArray[np.float64]]:
    """Parameter → float64 `[3, H, W, T]`."""
    return _Values(result, errors=False)


def derivative_errors(result: Result) -> Mapping[str, NDArray[np.float64]]:
    """Parameter → standard error of the sum over components, float64 `[H, W, T]`."""
    return _Values(result, errors=True)


def standard_error(tallies: NDArray[np.int64], second_moment: NDArray[np.uint64], batches: int) -> NDArray[np.float64]:
    """Of the sum over components of tallies `[3, ...]`, in their unit, from the spread between batches."""
    total = tallies.sum(axis=0).astype(np.float64)
    squares = second_moment[1] * 2.0**64 + second_moment[0]
    variance = np.maximum(squares - total**2 / batches, 0.0) / (batches - 1)
    return np.sqrt(batches * variance)
