"""Curves and points: photon budgets, sweeps, learning curves, and cases of the validation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from spadwarp.analytic.budgets import OUTLIERS, TOLERANCE, BudgetRow
from spadwarp.analytic.sweeps import Sweep
from spadwarp.scene import Scene
from spadwarp.scene.sections import field_unit, locate, parse_key
from spadwarp.viz import style
from spadwarp.viz.style import BLUE, PAGE, SERIES, log_axis, panel_grid, paper, save, wrapped

__all__ = ["draw_budget", "draw_learning_curves", "draw_sweep", "draw_validation"]

# Label, factor, and the widest range of values to show.
_COLUMNS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "signal": ("signal [detections per pulse]", 1.0, (1e-10, 1e3)),
    "sigma_depth": ("depth error, Cramér–Rao [mm]", 1e3, (1e-3, 1e4)),
    "signal_to_backscatter": ("signal to backscatter", 1.0, (1e-6, 1e6)),
    "pulses_for_1cm": ("pulses for 1 cm", 1.0, (1.0, 1e12)),
    "pulses": ("pulses for the depth error", 1.0, (1.0, 1e12)),
    "largest_range": ("largest range [m]", 1.0, (0.0, 1e3)),
}
_OF_BUDGETS = ("signal", "sigma_depth", "signal_to_backscatter", "pulses_for_1cm")
_OF_PLANS = ("pulses", "sigma_depth", "largest_range")


def draw_budget(rows: Sequence[BudgetRow], path: str | Path | None = None, *, width: float = PAGE) -> Figure:
    """Signal, depth error, signal to backscatter, pulses for 1 cm over range, a line a water; see `draw_sweep`."""
    waters = tuple((row.range, f"{row.medium}, c = {row.extinction:.3g} 1/m") for row in rows)
    curves = Sweep(fields=("range", "water"), values=waters, rows=tuple(rows), title="unscattered light alone")
    return draw_sweep(curves, path, width=width)


@paper()
def draw_sweep(curves: Sweep, path: str | Path | None = None, *, width: float = PAGE) -> Figure:
    """Panels over the values of the first field, a line for each combination of the others, see `spadwarp.sweep`.

    Of budgets those of `draw_budget`; of plans pulses for the depth error, bound, largest range. Linear axes begin
    at 0, and a curve that varies by less than a tenth has its span written into the panel. Dashed: a bound that is not
    reached, since more than 1 % of the fits would be outliers. Hollow: of a gate that was moved to the return, which
    leaves the light of near water out. A cross at the top: out of reach; a question mark: not
    judged by so few photons. Returns the figure of this width [inch], and writes it where `path` is given.
    """
    names, budgets = list(_OF_BUDGETS), isinstance(curves.rows[0], BudgetRow)
    if not budgets:
        # Where photons judge nothing, empty panels say so.
        names = [name for name in _OF_PLANS if not np.isnan(curves.column(name)).all()] or list(_OF_PLANS[:2])
    figure, axes = panel_grid(len(names), width, least=2.3, height=2.1, more=0.3)
    figure.caption("; ".join(filter(None, (curves.title, curves.unequal_energies))))
    at, others = [value[0] for value in curves.values], [value[1:] for value in curves.values]
    ticks = list(dict.fromkeys(map(str, at)))
    numeric = all(isinstance(value, (int, float)) for value in at)
    x = np.array(at, np.float64) if numeric else np.array([ticks.index(str(value)) for value in at], np.float64)
    groups = list(dict.fromkeys(map(repr, others)))
    missed = curves.column("outlier_probability") > OUTLIERS if budgets else np.zeros(len(at), bool)
    moved = curves.column("gate_moved").astype(bool) if budgets else np.zeros(len(at), bool)
    unjudged = np.zeros(len(at), bool) if budgets else np.isnan(curves.column("pulses"))
    unjudged &= not unjudged.all()  # then the panels say so
    for axis, name in zip(axes, names, strict=True):
        label, scale, (least, most) = _COLUMNS[name]
        y = curves.column(name) * scale
        y[np.isfinite(y) & ~((y >= least) & (y <= most))] = np.nan
        ends = [curves.column(end) if name == "pulses" else y for end in ("pulses_least", "pulses_most")]
        for number, group in enumerate(groups):
            own = np.array([repr(other) == group for other in others])
            place = x[own] + (0.0 if numeric else 0.12 * (number - 0.5 * (len(groups) - 1)))
            words = ", ".join(f"{x:.5g}" if isinstance(x, float) else str(x) for x in others[int(own.argmax())])
            style_of: dict[str, Any] = {"color": SERIES[number % len(SERIES)], "label": words or None}
            shown, every = np.where(np.isfinite(y[own]), y[own], np.nan), -(-int(own.sum()) // 12)
            spread = np.nan_to_num(np.abs(np.array(ends)[:, own] - shown), posinf=0.0) if name == "pulses" else None
            if name == "sigma_depth" and missed[own].any():
                axis.plot(place, shown, "--" if numeric else "_", color=style_of["color"], linewidth=0.8)
                shown = np.where(missed[own], np.nan, shown)
            axis.errorbar(place, shown, spread, fmt="o-" if numeric else "o", capsize=2.0, markevery=every, **style_of)
            hollow = np.where(moved[own], shown, np.nan)
            axis.plot(place, hollow, "o", color=style_of["color"], markerfacecolor="white", markevery=every, zorder=3)
            for mark, cases in (("x", np.isinf(y[own])), ("$?$", unjudged[own])):
                some, top, high = place[cases][::every], axis.get_xaxis_transform(), 0.97 - 0.04 * number
                axis.scatter(some, np.full(len(some), high), 25.0, style_of["color"], marker=mark, transform=top)
        if name == "sigma_depth" and curves.fields == ("range", "water"):
            asked = f"depth error of {100 * TOLERANCE:g} cm"
            axis.axhline(TOLERANCE * 1e3, color="0.4", linewidth=0.8, linestyle=":", label=asked)
        label = label if len(label) < 26 else label.replace(" [", "\n[")  # longer than an axis
        axis.set(xlabel=curves.fields[0] + _unit(curves.fields[0]), ylabel=label)
        _value_axis(axis, np.array([y, *ends]))
        if numeric:  # also where there is nothing to show
            axis.update_datalim(np.column_stack([x, x]), updatey=False)
        if not np.isfinite(y).any():
            style.middle_text(axis, "not enough photons\nto judge" if np.isnan(y).all() else "none is known")
            axis.tick_params(axis="y", which="both", left=False, labelleft=False)
        if not numeric:
            axis.set_xticks(range(len(ticks)), ticks, rotation=20, ha="right", rotation_mode="anchor")
            axis.set_xlim(-0.5, len(ticks) - 0.5)
        elif x.min() > 0 and x.max() > (2 if curves.fields[0] == "range" else 30) * x.min():
            log_axis(axis, "x")
        else:
            axis.locator_params(axis="x", nbins=5)
            axis.xaxis.minorticks_on()
    marks = {"--" if numeric else "_": (missed, f"not reached: over {100 * OUTLIERS:g} % false peaks")}
    marks |= {"o": (moved, "gate moved to the return")}
    marks |= {"x": (np.isinf(curves.column("pulses_for_1cm" if budgets else "pulses")), "out of reach")}
    marks |= {"$?$": (unjudged, "not enough photons to judge")}
    marks = {mark: (where, label) for mark, (where, label) in marks.items() if where.any()}
    for mark, (_, label) in marks.items():
        look = {"linestyle": mark} if mark == "--" else {"linestyle": "none", "marker": mark, "markersize": 5.0}
        axes[0].plot([], [], **look, color="0.4", markerfacecolor="white", linewidth=0.8, label=label)
    if len(groups) > 1 or marks:
        figure.key(axes, 2.3, title=", ".join(name + _unit(name) for name in curves.fields[1:]))
    if path is not None:
        save(figure, path)
    return figure


def _unit(field: str) -> str:
    """` [1/m]` for `medium.extinction`: the unit in the field's description, or nothing."""
    info = locate(Scene, parse_key(field))[1]
    unit = "m" if field == "range" else None if info is None else field_unit(info)
    return "" if unit in (None, "1") else f" [{unit}]"


def _value_axis(axis: Axes, y: NDArray[np.float64]) -> None:
    """Logarithmic over more than a factor of 20, else from 0."""
    known = y[np.isfinite(y)]
    positive = known[known > 0]
    if positive.size and positive.max() > 20 * positive.min():
        return log_axis(axis, "y")
    if known.size:
        axis.set_ylim(min(0.0, 1.1 * known.min()), 1.1 * known.max() or 1.0)
        span = np.ptp(known) / max(np.abs(known).max(), 1e-300)
        if 1e-6 < span < 0.1:
            text = f"{known.min():.4g} to {known.max():.4g}: a span of {100 * span:.2g} %"
            axis.text(0.03, 0.04, text, transform=axis.transAxes, fontsize="small", color="0.35")
    axis.yaxis.minorticks_on()


@paper()
def draw_learning_curves(
    log: Sequence[Mapping[str, Any]], path: str | Path, *, title: str, width: float = PAGE
) -> Path:
    """Loss and validation PSNR against steps; returns the picture's path.

    `log`: for each report its `step`, `loss`, `psnr` [dB], a mapping from the backscatter fraction, or from the signal
    photons per pixel (1 and more), to the PSNR there, and `input_psnr`, the mean without a network. `width`: [inch].
    """
    steps, losses = [line["step"] for line in log], [line["loss"] for line in log if line["loss"] is not None]
    drawn: dict[str, Any] = {"marker": "o", "markersize": 5.0 if len(losses) == 1 else 2.0}  # one point has no line
    levels = list(log[-1]["psnr"])
    counted = all(float(level) >= 1 for level in levels)
    figure, (loss, psnr) = panel_grid(2, width, least=3.0, height=2.1)
    loss.plot(steps[-len(losses) :], losses, color=BLUE, **drawn)
    loss.set(xlabel="step", ylabel="loss")
    if min(losses) > 0:  # "psnr" is a logarithm
        log_axis(loss, "y")
    for level, shade in zip(levels, np.linspace(0.85, 0.0, len(levels)), strict=True):
        drawn |= {"color": matplotlib.colormaps["viridis"](shade), "label": f"{float(level):g}" if counted else level}
        psnr.plot(steps, [line["psnr"][level] for line in log], **drawn)
    psnr.axhline(log[-1]["input_psnr"], color="0.4", linestyle="--", label="noisy input, mean")
    psnr.set(xlabel="step", ylabel="validation PSNR [dB]")
    for axis in (loss, psnr):
        axis.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    figure.key([psnr], 0.8, title="signal photons per pixel" if counted else "backscatter fraction")
    figure.caption(title)
    return save(figure, path)


@paper()
def draw_validation(rows: Sequence[Mapping[str, Any]], path: str | Path, *, title: str, width: float = PAGE) -> Path:
    """Draws the quantities of a case as a PNG; returns its path.

    `rows`: of each `quantity` its `value`, `reference`, `standard_error`, `z` and whether it `passed`. `width`: of the
    picture [inch]. Raises `FileError`.
    """
    names = [wrapped(row["quantity"], 0.36 * width, size=7) for row in rows]
    figure = style.new_figure(width, 0.65 + 0.15 * sum(name.count("\n") + 2 for name in names))
    figure.caption(title)
    ratio, deviation = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for y, row in enumerate(rows):
        marks: dict[str, Any] = {"color": BLUE if row["passed"] else style.RED, "marker": "o" if row["passed"] else "X"}
        if reference := row["reference"]:
            error = abs(row["standard_error"] / reference)
            ratio.errorbar(row["value"] / reference - 1.0, y, xerr=error, linestyle="none", **marks)
        if math.isfinite(row["z"]):
            deviation.plot(row["z"], y, **marks)
    ratio.axvline(0.0, color="0.6", linewidth=0.8)
    ratio.set(xlabel="value / reference − 1", ylim=(len(rows) - 0.5, -0.5))
    ratio.set_yticks(range(len(rows)), names)
    deviation.axvspan(-2.0, 2.0, color="0.92", zorder=0)
    reach = 1.1 * max(2.5, *(abs(row["z"]) for row in rows if math.isfinite(row["z"])), 0.0)
    deviation.set_xlim(-reach, reach)
    deviation.set_xlabel(wrapped("z (grey: within 2)", 0.22 * width))
    if not any(row["reference"] for row in rows):
        style.middle_text(ratio, "every reference is 0", color="0.35")
    for axis in (ratio, deviation):
        axis.locator_params(axis="x", nbins=4)
        axis.xaxis.minorticks_on()
        style.plain_axis(axis)
    return save(figure, path)
