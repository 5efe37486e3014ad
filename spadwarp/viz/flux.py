"""Pictures of the light inside the water: profiles over planes, and slices of volumes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from spadwarp.result import FluxValues, Result, apparent
from spadwarp.values import ConfigError
from spadwarp.viz import style
from spadwarp.viz.style import INTENSITY_MAP, SERIES, colour_map, log_axis, plain_axis

_PROPERTIES = {"attenuation": "K_d [1/m]", "reflectance": "R", "mean_cosine": "mean cosine"}
_LEAST = 1e-5  # of the brightest voxel, that a slice shows


def flux_figure(result: Result, caption: str, width: float) -> Figure:
    """A row for each section of `[[flux]]`. Raises `ConfigError` without any."""
    sections = result.scene.flux
    if not sections:
        raise ConfigError("kind = 'flux' needs a result with [[flux]]", source=result.scene.source)
    figure = style.new_figure(width, 2.7 * len(sections))
    figure.caption(caption)
    axes = figure.subplots(len(sections), 2, squeeze=False)
    for section, (left, right) in zip(sections, axes, strict=True):
        if section.positions is None:
            for axis, planes in ((left, "zx"), (right, "zy")):
                _slice(figure, axis, section.name, result.flux[section.name]["fluence"], planes)
        else:
            _profiles(result, section.name, left, right)
    return figure


def _profiles(result: Result, section: str, left: Axes, right: Axes) -> None:
    """Irradiances over the planes, and what follows from them."""
    light = result.flux[section]["irradiance"]
    position, kinds = light.dimensions["position"][0], light.dimensions["kind"][0]
    for axis in (left, right):
        plain_axis(axis)
        axis.set(ylabel="along the axis [m]", ylim=(position[-1], position[0]) if len(position) > 1 else None)
    for k, kind in enumerate(kinds):
        values = np.where(light.values[:, k] > 0, light.values[:, k], np.nan)
        label = kind.replace("_", " ")
        error = None if light.errors is None else light.errors[:, k]
        left.errorbar(values, position, xerr=error, fmt=".-", color=SERIES[k], label=label, linewidth=0.9)
    left.set(xlabel=f"irradiance per photon [{light.unit}]", title=section)
    log_axis(left, "x")
    left.legend(fontsize=6.5)
    if light.errors is None:
        style.middle_text(right, "too few batches")
        return
    found = apparent(result, section)
    for k, (name, label) in enumerate(_PROPERTIES.items()):
        places = found.middle if name == "attenuation" else found.position
        error = found.errors[name]
        right.errorbar(getattr(found, name), places, xerr=error, fmt=".-", color=SERIES[k], label=label, linewidth=0.9)
    right.set(xlabel="K_d, R, mean cosine", title="apparent optical properties")
    log_axis(right, "x")
    right.legend(fontsize=6.5)


def _slice(figure: Figure, axis: Axes, section: str, light: FluxValues, planes: str) -> None:
    """Fluence in all gates on the middle plane across the third axis; z to the right."""
    across = next(name for name in "xyz" if name not in planes)
    cube = light.values.sum(axis=0)
    image = np.take(cube, cube.shape["xyz".index(across)] // 2, axis="xyz".index(across))
    sides = [np.asarray(light.dimensions[name][0]) for name in planes]
    steps = [float(side[1] - side[0]) if len(side) > 1 else 1.0 for side in sides]
    ends = [(side[0] - 0.5 * step, side[-1] + 0.5 * step) for side, step in zip(sides, steps, strict=True)]
    axis.set(xlabel=f"{planes[0]} [m]", ylabel=f"{planes[1]} [m]", title=f"{section}, across {across}")
    top = float(cube.max())
    if not top > 0.0:
        style.middle_text(axis, "no light")
        return
    look: Any = {"norm": LogNorm(_LEAST * top, top), "cmap": colour_map(INTENSITY_MAP), "interpolation": "nearest"}
    shown = axis.imshow(np.maximum(image, _LEAST * top), extent=(*ends[0], ends[1][1], ends[1][0]), **look)
    figure.colorbar(shown, ax=axis, label=f"fluence [{light.unit}]", shrink=0.6)
