"""The order of the axes of measured histograms: given, or inferred where there is one answer alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError

__all__ = ["image_shape", "to_frames"]

_LEAST_BINS = 8  # of a histogram that is worth one
_CLEARLY = 2.0  # as far from a square as the other order, and the choice is clear


def to_frames(values: NDArray[Any], axes: str | None) -> tuple[NDArray[Any], str | None]:
    """Histograms `[H, W, T]` or `[frames, H, W, T]` from any order of axes, and what was inferred, in words.

    Args:
        values: Of three or four dimensions.
        axes: A letter for each dimension: y rows, x columns, t bins, n frames, such as "tyx"; None: inferred.

    Raises:
        ArgumentError: Letters that do not fit, or an order that is missing because two are plausible.
    """
    letters = "yxt" if values.ndim == 3 else "nyxt"
    said = None
    if axes is None:
        axes = _inferred(values.shape, letters)
        said = f"axes: {_in_words(values.shape, axes)} (axes = {axes})"
    elif sorted(axes) != sorted(letters):
        raise ArgumentError(f"axes = {axes!r} are not the letters of {letters} in any order, for shape {values.shape}")
    return np.transpose(values, [axes.index(letter) for letter in letters]), said


def _inferred(shape: tuple[int, ...], letters: str) -> str:
    """Bins last or, before the image, first: the order whose image is clearly nearer to a square."""
    orders = (letters, letters.replace("yxt", "tyx"))
    plausible = {}
    for order in orders:
        sizes = dict(zip(order, shape, strict=True))
        if sizes["t"] >= _LEAST_BINS:
            plausible[order] = max(sizes["y"], sizes["x"]) / max(min(sizes["y"], sizes["x"]), 1)
    best = sorted(plausible, key=lambda order: plausible[order])
    if len(best) == 1 or (best and plausible[best[0]] * _CLEARLY <= plausible[best[1]]):
        return best[0]
    raise ArgumentError(
        f"the order of the axes is missing (axes): shape {shape} may be "
        + " or ".join(f"{order} ({_in_words(shape, order)})" for order in orders)
    )


def _in_words(shape: tuple[int, ...], axes: str) -> str:
    size = dict(zip(axes, shape, strict=True))
    frames = f"{size['n']} frames of " if "n" in size else ""
    return f"{frames}{size['x']} x {size['y']} pixels, {size['t']} bins"


def image_shape(pixels: int, given: tuple[int, int] | None, shapes: list[tuple[int, ...]]) -> tuple[int, int]:
    """(height, width) of an image of so many pixels: given, or the only shape of other arrays that has as many.

    Raises `ArgumentError` where none or several do.
    """
    if given is not None:
        if given[0] * given[1] != pixels:
            raise ArgumentError(f"image size = {given[1]} x {given[0]} has {given[0] * given[1]} pixels, not {pixels}")
        return given
    found = {shape for shape in shapes if len(shape) == 2 and min(shape) > 1 and shape[0] * shape[1] == pixels}
    if len(found) != 1:
        raise ArgumentError(f"the image's size is missing (image_size): {pixels} pixels, one after the other")
    (height, width), *_ = found
    return height, width
