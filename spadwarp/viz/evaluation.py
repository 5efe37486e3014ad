"""Figures of a comparison of denoisers, and RMSE against photons: plain tables in, pictures out.

Scores come as `{(method, target, level): {field: value}}`, samples as tuples of true depth `[H, W]` [m], gate [m],
depth by method and a caption. A level is a backscatter fraction, the part of the pixels that report backscatter, or a
range of photon counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.viz.style import (
    BLUE,
    DEPTH_MAP,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    colour_map,
    new_figure,
    plain_axis,
    save,
)

__all__ = ["COLOURS", "SCORES", "TITLES", "draw_photon_sweep", "draw_ranking", "draw_reliability", "draw_samples"]
__all__ += ["draw_scores"]

_METHODS = {
    "input": ("noisy input", "0.55"),
    "median": ("median, best window", ORANGE),
    "gating": ("backscatter gating", SKY),
    "bm3d": ("BM3D", PURPLE),
    "usdn": ("USDN", GREEN),
    "dncnn": ("DnCNN", RED),
    "pyramid": ("PyramidNet", BLUE),
    "histograms": ("PyramidNet, histograms", "black"),
    "likelihood": ("likelihood of each pixel", "0.4"),
    "pooled": ("pooled likelihood", "0.5"),
    "semi-global": ("semi-global matching", "0.6"),
    "total-variation": ("total variation", "0.7"),
}

TITLES = {method: title for method, (title, _) in _METHODS.items()}
"""Names of methods in tables and figures."""

COLOURS = {method: colour for method, (_, colour) in _METHODS.items()}
"""Colours of methods in figures."""

SCORES = {
    "psnr": ("PSNR [dB]", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "entropy": ("entropy [bit]", "{:.2f}"),
    "rmse_mm": ("RMSE [mm]", "{:.1f}"),
    "within_1cm": ("within 1 cm", "{:.1%}"),
    "within_5cm": ("within 5 cm", "{:.1%}"),
    "edge_mm": ("edge error [mm]", "{:.1f}"),
}
"""Title and format of each score."""

Sample = tuple[NDArray[np.float32], tuple[float, float], Mapping[str, NDArray[np.float32]], str]


def draw_scores(
    scores: Mapping[tuple[str, str, str], Mapping[str, float]],
    path: str | Path,
    *,
    methods: Sequence[str],
    targets: Sequence[str],
    levels: Sequence[str],
    note: str,
) -> Path:
    """Scores against the level, target by target; `note` is written below. Returns the path."""
    fields = ("psnr", "ssim", "entropy", "rmse_mm")
    width = max(3.1 * len(targets) + 1.0, 5.2)
    figure = new_figure(width, 2.3 * len(fields) + 0.9)
    axes = figure.subplots(len(fields), len(targets), squeeze=False, sharex=True, sharey="row")
    counted = any("photons" in level for level in levels)
    places = [float(k) for k in range(len(levels))] if counted else [float(level) for level in levels]
    labels = [level.removesuffix(" photons") if counted else level.lstrip("0") for level in levels]
    for axis, field in zip(axes[:, 0], fields, strict=True):
        axis.set_ylabel(SCORES[field][0])
        axis.set_yscale("log" if field == "rmse_mm" else "linear")
    lines: dict[str, Any] = {}
    for column, target in enumerate(targets):
        for axis, field in zip(axes[:, column], fields, strict=True):
            for method in methods:
                points = [
                    (x, scores[method, target, level][field])
                    for x, level in zip(places, levels, strict=True)
                    if (method, target, level) in scores
                ]
                if points:
                    bold = method == "pyramid"
                    (lines[method],) = axis.plot(*zip(*points, strict=True), **_line(method, bold), zorder=2 + bold)
            plain_axis(axis)
        axes[0, column].set_title(target.replace("_", " "), fontsize=11)
        axes[-1, column].set_xticks(places, labels, fontsize=8)
        axes[-1, column].set_xlabel("signal photons per pixel" if counted else "backscatter fraction")
    names = [TITLES[name] for name in lines]
    columns = min(len(names), int(width / 1.7))  # 1.7 inches hold the longest name and its line
    figure.legend(list(lines.values()), names, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
    return save(figure, path, note=note, dpi=130)


def draw_samples(
    samples: Sequence[Sample],
    path: str | Path,
    *,
    methods: Sequence[str],
    note: str,
    rescaled: bool = False,
    enlarged: bool = False,
) -> Path:
    """A row for each sample: truth, then the methods. Returns the path.

    `rescaled`: colours over the depth of the target, not over the gate. `enlarged`: only the part with most edges.
    """
    methods = [name for name in methods if any(name in images for _, _, images, _ in samples)]
    columns = 1 + len(methods)
    height, width = samples[0][0].shape
    ratio = 1.0 if enlarged else height / width
    figure = new_figure(2.05 * columns + 0.7, (2.05 * ratio + 0.34) * len(samples) + 0.5)
    axes = figure.subplots(len(samples), columns, squeeze=False)
    for axis, title in zip(axes[0], ["truth", *(TITLES[name] for name in methods)], strict=True):
        axis.set_title(title, fontsize=9)
    for row, (clean, gate, images, caption) in zip(axes, samples, strict=True):
        part = _detail(clean, gate) if enlarged else (slice(None), slice(None))
        low, high = _limits(clean[part], gate) if rescaled else gate
        for axis, (name, image) in zip(row, [("truth", clean), *((n, images.get(n)) for n in methods)], strict=True):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_color("0.8")
            if image is None:
                axis.text(0.5, 0.5, "not run", ha="center", va="center", color="0.5", transform=axis.transAxes)
                continue
            visible = np.where(np.isfinite(clean) | (name == "input"), image, np.nan)[part]
            drawn = axis.imshow(visible, cmap=colour_map(DEPTH_MAP), vmin=low, vmax=high, interpolation="nearest")
        bar = figure.colorbar(drawn, ax=list(row), fraction=0.02, pad=0.01)
        bar.set_label("depth z [m]", fontsize=8)
        bar.ax.tick_params(labelsize=7)
        bar.outline.set_visible(False)
        text = row[0].text(0.0, -0.04, caption, fontsize=7.5, va="top", transform=row[0].transAxes)
        text.set_in_layout(False)  # may extend below the other images
    figure.get_layout_engine().set(hspace=0.1)  # type: ignore[call-arg,union-attr]
    return save(figure, path, note=f"grey: no target; {note}", dpi=130)


def draw_ranking(
    means: Mapping[str, Mapping[str, float]], path: str | Path, *, larger_is_better: Mapping[str, bool], note: str
) -> Path:
    """Mean scores `{method: {field: value}}` as bars, the first method on top. Returns the path."""
    fields = ("psnr", "ssim", "rmse_mm", "edge_mm")
    order = list(means)[::-1]
    figure = new_figure(12.0, 0.42 * len(order) + 1.5)
    for axis, field in zip(figure.subplots(1, len(fields), sharey=True), fields, strict=True):
        values = [means[method][field] for method in order]
        axis.barh(range(len(order)), values, color=[COLOURS[method] for method in order], height=0.7)
        for y, value in enumerate(values):
            axis.text(value, y, " " + SCORES[field][1].format(value), va="center", fontsize=8)
        axis.set_yticks(range(len(order)), [TITLES[method] for method in order])
        axis.set_xlim(0, 1.25 * max(values))
        axis.set_xlabel(SCORES[field][0] + (" (more is better)" if larger_is_better[field] else " (less is better)"))
        axis.spines[["top", "right"]].set_visible(False)
    return save(figure, path, note=note, dpi=130)


def draw_photon_sweep(
    rmse: Mapping[str, NDArray[np.float64]],
    bound: NDArray[np.float64],
    path: str | Path,
    *,
    photons: Sequence[float],
    sbr: Sequence[float],
    note: str,
) -> Path:
    """RMSE [m] by method `[S, P]` against signal photons `[P]`, beside the Cramér–Rao bound `[S, P]` [m].

    One panel for each signal-to-background ratio (SBR), `[S]`. Returns the path.
    """
    columns = len(sbr)
    figure = new_figure(3.3 * columns + 0.4, 3.9)
    axes = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
    for row, (axis, ratio) in enumerate(zip(axes, sbr, strict=True)):
        for name, values in rmse.items():
            label = "likelihood of each pixel" if name == "input" else TITLES[name]
            axis.plot(photons, 1e3 * values[row], label=label, **_line(name, name == "histograms"))
        axis.plot(photons, 1e3 * bound[row], color="black", linestyle=":", label="Cramér–Rao bound of a pixel")
        axis.set(xscale="log", yscale="log", xlabel="signal photons per pixel", title=f"SBR {ratio:g}")
        plain_axis(axis, grid="both")
    axes[0].set_ylabel("RMSE of depth [mm]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8.5)
    return save(figure, path, note=note)


def draw_reliability(tables: Mapping[tuple[str, str], NDArray[np.int64]], path: str | Path, *, note: str) -> Path:
    """How often it was true, against the probability that was given, by tenths; returns the path.

    `tables`: by method and what the probability is of, pixels and those of which it was true, `[10, 2]`.
    """
    figure = new_figure(9.0, 3.9)
    axes = figure.subplots(1, 2, sharey=True)
    kinds = {"target": "the pixel sees a target", "confidence": "its depth is right to 1 % of the gate"}
    for axis, (kind, title) in zip(axes, kinds.items(), strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linestyle=":")
        for (method, of), table in tables.items():
            if of == kind:
                some = table[:, 0] >= 20
                middle, part = (np.arange(10) + 0.5) / 10, table[:, 1] / np.maximum(table[:, 0], 1)
                axis.plot(middle[some], part[some], **_line(method, True))
        axis.set(xlabel="probability given", title=title, xlim=(0, 1), ylim=(0, 1))
        plain_axis(axis)
    axes[0].set_ylabel("part of the pixels of which it is true")
    return save(figure, path, note=note)


# Parts


def _line(method: str, bold: bool) -> dict[str, Any]:
    line = {"linewidth": 2.2 if bold else 1.2, "linestyle": "--" if method == "input" else "-"}
    return {"color": COLOURS[method], "marker": "o", "markersize": 3.5, **line}


def _limits(clean: NDArray[np.float32], gate: tuple[float, float]) -> tuple[float, float]:
    depths = clean[np.isfinite(clean) & (clean < gate[1])]
    low, high = (float(depths.min()), float(depths.max())) if depths.size else gate
    return low - 0.05 * (high - low) - 0.01, high + 0.05 * (high - low) + 0.01


def _detail(clean: NDArray[np.float32], gate: tuple[float, float]) -> tuple[slice, slice]:
    """A square of a quarter of the height where the truth has most edges."""
    depth = np.nan_to_num(clean, nan=gate[1] + 0.5)
    edges = np.minimum(np.abs(np.diff(depth, axis=0))[:, :-1] + np.abs(np.diff(depth, axis=1))[:-1], 0.3)
    side = max(16, clean.shape[0] // 4)
    total = np.pad(edges.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    row, column = map(int, np.unravel_index(int(sums.argmax()), sums.shape))
    return slice(row, row + side), slice(column, column + side)
