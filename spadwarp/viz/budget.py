"""Pictures of photon budgets and sweeps."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from spadwarp.analytic.photon_budget import OUTLIERS, TOLERANCE, BudgetRow
from spadwarp.analytic.sweeps import Sweep
from spadwarp.scene import Scene
from spadwarp.viz.style import SERIES, new_figure, plain_axis, save

__all__ = ["draw_budget", "draw_sweep"]

# Label, factor, and the widest range of values to show.
_PANELS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "signal": ("signal [detections per pulse]", 1.0, (1e-10, 1e3)),
    "sigma_depth": ("depth error, Cramér–Rao [mm]", 1e3, (1e-3, 1e4)),
    "signal_to_backscatter": ("signal to backscatter", 1.0, (1e-6, 1e6)),
    "pulses_for_1cm": ("pulses for 1 cm", 1.0, (1.0, 1e12)),
}
_ERROR_PANELS = ("sigma_depth", "outlier_probability", "estimate_fraction", "signal_to_backscatter")
_LABELS: dict[str, tuple[str, float]] = {
    **{name: (label, scale) for name, (label, scale, _) in _PANELS.items()},
    "alpha": ("detections per pulse α", 1.0),
    "background": ("background [detections per pulse]", 1.0),
    "sigma_time": ("timing error, Cramér–Rao [ps]", 1e12),
    "sigma_depth_p90": ("depth error, 90th percentile [mm]", 1e3),
    "outlier_probability": ("outlier probability", 1.0),
    "estimate_fraction": ("pixels with an estimate", 1.0),
}


def draw_budget(rows: Sequence[BudgetRow], path: str | Path | None = None) -> Figure:
    """Four panels over range, a line for each water: signal, depth error, signal to backscatter, pulses for 1 cm.

    Where more than 1 % of the fits would be outliers, the bound is dashed: it is not reached. Returns the matplotlib
    figure, and writes it where `path` is given.
    """
    waters = list(dict.fromkeys(row.medium for row in rows))
    figure, axes = _grid(len(_PANELS))
    for number, name in enumerate(waters):
        own = [row for row in rows if row.medium == name]
        x = np.array([row.range for row in own])
        for axis, (field, (_, scale, shown)) in zip(axes, _PANELS.items(), strict=True):
            y = np.array([getattr(row, field) for row in own]) * scale
            y[~(np.isfinite(y) & (y > 0.01 * shown[0]) & (y < 100 * shown[1]))] = np.nan
            colour = SERIES[number % len(SERIES)]
            label = f"{name} ({own[0].extinction:.3g}/m)"
            if field == "sigma_depth":
                sure = np.array([row.outlier_probability <= OUTLIERS for row in own])
                axis.plot(x, y, "--", color=colour, linewidth=1.0)
                y = np.where(sure, y, np.nan)
            axis.plot(x, y, "o-", color=colour, markersize=3.5, linewidth=1.6, label=label)
    for axis, (label, _, shown) in zip(axes, _PANELS.values(), strict=True):
        axis.set(xlabel="range [m]", ylabel=label, xscale="log", yscale="log")
        low, high = axis.get_ylim()
        low, high = max(low, shown[0]), min(high, shown[1])
        axis.set(yscale="log" if high > 20 * low else "linear", ylim=(low, high))
        _plain_range_ticks(axis, [row.range for row in rows])
    axes[1].axhline(TOLERANCE * 1e3, color="0.5", linewidth=0.8, linestyle=":")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)), frameon=False, fontsize=9)
    if path is not None:
        save(figure, path)
    return figure


def draw_sweep(curves: Sweep, path: str | Path | None = None, *, columns: Sequence[str] | None = None) -> Figure:
    """One panel for each column over the values of the swept field; returns the matplotlib figure, writes it to `path`.

    `columns`: attributes of the rows; default: what matters most.
    """
    budgets = isinstance(curves.rows[0], BudgetRow)
    names = list(columns or (_PANELS if budgets else _ERROR_PANELS))
    figure, axes = _grid(len(names))
    numeric = all(isinstance(value, (int, float)) for value in curves.values)
    x: Any = np.array(curves.values, np.float64) if numeric else [str(value) for value in curves.values]
    for number, (axis, name) in enumerate(zip(axes, names, strict=False)):
        label, scale = _LABELS.get(name, (name, 1.0))
        y = curves.column(name) * scale
        positive = y[np.isfinite(y) & (y > 0)]
        axis.plot(
            x, np.where(np.isfinite(y), y, np.nan), "o-", color=SERIES[number % 5], markersize=3.5, label="median"
        )
        if name == "sigma_depth" and not budgets:
            p90 = curves.column("sigma_depth_p90") * scale
            axis.plot(x, p90, "--", color=SERIES[number % 5], linewidth=1.0, label="90 % of the pixels below")
            axis.legend(frameon=False, fontsize=9)
        axis.set(xlabel=f"{curves.field} {_unit(curves.field)}".rstrip(), ylabel=label)
        if name in ("outlier_probability", "estimate_fraction"):
            axis.set_ylim(-0.03, 1.03)
        elif positive.size and positive.max() > 20 * positive.min():
            axis.set_yscale("log")
        if numeric and x.min() > 0 and x.max() > 30 * x.min():
            axis.set_xscale("log")
    if path is not None:
        save(figure, path)
    return figure


def _unit(field: str) -> str:
    """`[1/m]` for `medium.extinction`: the unit at the end of the field's description, or nothing."""
    section, _, name = field.partition(".")
    info = Scene.model_fields.get(section)
    fields = getattr(info.annotation, "model_fields", {}) if info else {}
    found = re.search(r"\[[^\]]+\]", getattr(fields.get(name), "description", None) or "")
    return found.group(0) if found else ""


def _grid(panels: int) -> tuple[Figure, list[Axes]]:
    columns = 2 if panels in (2, 4) else min(panels, 3)
    lines = math.ceil(panels / columns)
    figure = new_figure(4.6 * columns, 3.3 * lines + 0.4)
    axes = list(np.ravel(figure.subplots(lines, columns)))
    for axis in axes[panels:]:
        axis.remove()
    for axis in axes[:panels]:
        plain_axis(axis)
    return figure, axes[:panels]


def _plain_range_ticks(axis: Axes, ranges: Sequence[float]) -> None:
    low, high = min(ranges), max(ranges)
    ticks = sorted(set(ranges))
    if len(ticks) > 6:
        ticks = [m * 10.0**e for e in range(-2, 4) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if len(ticks) > 1:
        axis.set_xlim(low * (low / high) ** 0.05, high * (high / low) ** 0.05)  # also where nothing comes back
        axis.xaxis.set_major_locator(FixedLocator(ticks))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
