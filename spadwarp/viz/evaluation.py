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
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from spadwarp.viz.style import (
    BLUE,
    DEPTH_MAP,
    GREEN,
    ORANGE,
    PAGE,
    PURPLE,
    RED,
    SKY,
    colour_map,
    columns_that_fit,
    log_axis,
    mark_pixels,
    middle_text,
    new_figure,
    panel_grid,
    paper,
    plain_axis,
    save,
    wrapped,
)

METHODS = {
    "input": ("noisy input", "0.5", "x", "--"),
    "median": ("median, best window", ORANGE, "s", "-."),
    "gating": ("backscatter gating", SKY, "v", "-"),
    "bm3d": ("BM3D", PURPLE, "D", "-"),
    "usdn": ("USDN", GREEN, "^", "-"),
    "dncnn": ("DnCNN", RED, "P", "-"),
    "pyramid": ("PyramidNet", BLUE, "o", "-"),
    "histograms": ("PyramidNet, histograms", "black", "*", "-"),
    "likelihood": ("likelihood of each pixel", "0.35", "+", ":"),
    "pooled": ("pooled likelihood", "#882255", "<", "-"),
    "semi-global": ("semi-global matching", "#999933", ">", "-"),
    "total-variation": ("total variation", "#332288", "h", "-."),
    "belief-propagation": ("belief propagation", "#44AA99", "p", "-"),
}
"""Title, colour, marker and line of each method: Okabe and Ito's colours, then some of Paul Tol's muted ones."""

TITLES = {method: title for method, (title, *_) in METHODS.items()}
"""Names of methods in tables and figures."""

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

_MARKS = _NO_TARGET, _MISSED, _INVENTED = "grey: no target", "black: target missed", "red: target invented"

Sample = tuple[NDArray[np.float32], tuple[float, float], Mapping[str, NDArray[np.float32]], str]


@paper()
def draw_scores(
    scores: Mapping[tuple[str, str, str], Mapping[str, float]],
    path: str | Path,
    *,
    methods: Sequence[str],
    targets: Sequence[str],
    levels: Sequence[str],
    note: str,
    width: float = PAGE,
) -> Path:
    """Scores against the level, target by target; `note` is written below. Returns the path.

    `width`: of the picture [inch], more where there are too many targets for it.
    """
    fields = ("psnr", "ssim", "entropy", "rmse_mm")
    width = max(width, 1.3 * len(targets) + 0.6)
    in_line = columns_that_fit(len(methods), width, 1.75)
    figure = new_figure(width, 1.45 * len(fields) + 1.0 + 0.15 * (len(methods) // in_line))
    axes = figure.subplots(len(fields), len(targets), squeeze=False, sharex=True, sharey="row")
    counted = any("photons" in level for level in levels)
    places = [float(k) for k in range(len(levels))] if counted else [float(level) for level in levels]
    labels = [level.removesuffix(" photons") if counted else level for level in levels]
    every = -(-len(labels) // max(2, int((width - 0.6) / len(targets) / 0.4)))
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
        axes[0, column].set_title(target.replace("_", " "))
        axes[-1, column].set_xticks(places[::every], labels[::every])
        axes[-1, column].set_xlabel(wrapped("signal photons per pixel" if counted else "backscatter fraction", 1.25))
    for axis, field in zip(axes[:, 0], fields, strict=True):
        axis.set_ylabel(SCORES[field][0])
        if field == "rmse_mm":
            log_axis(axis, "y")
    names = [TITLES[name] for name in lines]
    figure.legend(list(lines.values()), names, loc="outside upper center", ncols=in_line)
    return save(figure, path, note=note)


@paper()
def draw_samples(
    samples: Sequence[Sample],
    path: str | Path,
    *,
    methods: Sequence[str],
    note: str,
    rescaled: bool = False,
    enlarged: bool = False,
    width: float = PAGE,
) -> Path:
    """A row for each sample: truth, then the methods. Returns the path.

    Grey: neither the truth nor the method sees a target. Black: a target is missed. Red: a target is invented. The
    note below explains those that there are.
    `rescaled`: colours over the depth of the target, not over the gate. `enlarged`: only the part with most edges.
    `width`: of the picture [inch], more where there are too many methods for it.
    """
    methods = [name for name in methods if any(name in images for _, _, images, _ in samples)]
    columns = 1 + len(methods)
    cell = max((width - 0.5) / columns, 0.8)
    height, across = samples[0][0].shape
    ratio = 1.0 if enlarged else height / across
    figure = new_figure(cell * columns + 0.5, (cell * ratio + 0.28) * len(samples) + 0.75)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.02)  # type: ignore[call-arg,union-attr]
    axes = figure.subplots(len(samples), columns, squeeze=False)
    for axis, title in zip(axes[0], ["truth", *(TITLES[name] for name in methods)], strict=True):
        axis.set_title(wrapped(title, cell - 0.05, size=7), fontsize=7)
    marks: set[str] = set()
    for row, (clean, gate, images, caption) in zip(axes, samples, strict=True):
        part = _detail(clean, gate) if enlarged else (slice(None), slice(None))
        low, high = _limits(clean[part], gate) if rescaled else gate
        target = np.isfinite(clean) & (clean < gate[1])
        for axis, (name, image) in zip(row, [("truth", clean), *((n, images.get(n)) for n in methods)], strict=True):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_color("0.8")
            if image is None:
                middle_text(axis, "not run", color="0.5")
                continue
            shown = np.where(target, image, np.nan)[part]
            drawn = axis.imshow(shown, cmap=colour_map(DEPTH_MAP), vmin=low, vmax=high)
            found = np.isfinite(image)
            missed, invented = (target & ~found)[part], (found & ~target)[part]
            if name != "truth":
                mark_pixels(axis, missed, invented)
                marks |= {text for text, of in ((_MISSED, missed), (_INVENTED, invented)) if of.any()}
            marks |= {_NO_TARGET} if not (found | target)[part].all() else set()
        bar = figure.colorbar(drawn, ax=list(row), fraction=0.02, pad=0.01)
        bar.set_label("depth z [m]", fontsize=7)
        bar.ax.locator_params(axis="y", nbins=4)
        bar.ax.tick_params(labelsize=6)
        bar.outline.set_visible(False)
        row[0].set_xlabel(" ", fontsize=6.5)  # the place of the caption, which may extend below the other images
        row[0].annotate(
            caption, (0.0, 0.0), (0.0, -2.0), xycoords="axes fraction", textcoords="offset points", fontsize=6.5,
            va="top",
        ).set_in_layout(False)  # fmt: skip
    _fit_height(figure, list(axes[:, 0]), ratio)
    return save(figure, path, note="; ".join([*(text for text in _MARKS if text in marks), note]))


@paper()
def draw_ranking(
    means: Mapping[str, Mapping[str, float]],
    path: str | Path,
    *,
    larger_is_better: Mapping[str, bool],
    note: str,
    width: float = PAGE,
) -> Path:
    """Mean scores `{method: {field: value}}` as bars, the first method on top. Returns the path.

    `width`: of the picture [inch].
    """
    fields = ("psnr", "ssim", "rmse_mm", "edge_mm")
    order = list(means)[::-1]
    figure, axes = panel_grid(4, width, least=1.6, height=0.24 * len(order) + 0.65, more=0.45, sharey=True)
    for axis, field in zip(axes, fields, strict=True):
        axis.grid(False)
        values = [means[method][field] for method in order]
        axis.barh(range(len(order)), values, color=[METHODS[method][1] for method in order], height=0.7)
        for y, value in enumerate(values):
            axis.text(value, y, " " + SCORES[field][1].format(value), va="center", fontsize=6.5)
        axis.set_yticks(range(len(order)), [TITLES[method] for method in order])
        axis.set_xlim(0, 1.45 * max(values))
        axis.locator_params(axis="x", nbins=3)
        better = "more is better" if larger_is_better[field] else "less is better"
        axis.set_xlabel(f"{SCORES[field][0]}\n({better})")
    return save(figure, path, note=note)


@paper()
def draw_photon_sweep(
    rmse: Mapping[str, NDArray[np.float64]],
    bound: NDArray[np.float64],
    path: str | Path,
    *,
    photons: Sequence[float],
    sbr: Sequence[float],
    note: str,
    width: float = PAGE,
) -> Path:
    """RMSE [m] by method `[S, P]` against signal photons `[P]`, beside the Cramér–Rao bound `[S, P]` [m].

    One panel for each signal-to-background ratio (SBR), `[S]`. `width`: of the picture [inch]. Returns the path.
    """
    in_line = columns_that_fit(len(rmse) + 1, width, 1.75)
    more = 0.7 + 0.14 * (len(rmse) // in_line)
    figure, axes = panel_grid(len(sbr), width, least=1.6, height=2.3, more=more, sharex=True, sharey=True)
    for row, (axis, ratio) in enumerate(zip(axes, sbr, strict=True)):
        for name, values in rmse.items():
            label = "likelihood of each pixel" if name == "input" else TITLES[name]
            axis.plot(photons, 1e3 * values[row], label=label, **_line(name, name == "histograms"))
        axis.plot(photons, 1e3 * bound[row], color="black", linestyle=":", label="Cramér–Rao bound of a pixel")
        axis.set(xscale="log", yscale="log", title=f"signal to background {ratio:g}")
        columns = axis.get_subplotspec().get_gridspec().ncols  # type: ignore[union-attr]
        if row % columns == 0:
            axis.set_ylabel("RMSE of depth [mm]")
        if row >= len(sbr) - columns:
            axis.set_xlabel("signal photons per pixel")
            axis.tick_params(labelbottom=True)
    for axis in axes:
        log_axis(axis, "x", most=4)
        log_axis(axis, "y")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=in_line)
    return save(figure, path, note=note)


@paper()
def draw_reliability(
    tables: Mapping[tuple[str, str], NDArray[np.int64]], path: str | Path, *, note: str, width: float = PAGE
) -> Path:
    """How often it was true, against the probability that was given, by tenths; returns the path.

    `tables`: by method and what the probability is of, pixels and those of which it was true, `[10, 2]`. A bar is the
    standard error of a part of so many pixels, taken as independent. `width`: of the picture [inch].
    """
    figure, axes = panel_grid(2, width, least=2.8, height=2.3, more=1.0, sharex=True, sharey=True)
    kinds = {"target": "the pixel sees a target", "confidence": "its depth is right to 1 % of the gate"}
    for axis, (kind, title) in zip(axes, kinds.items(), strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linestyle=":", label="exactly right")
        for (method, of), table in tables.items():
            if of == kind:
                some = table[:, 0] >= 20
                middle, part = (np.arange(10) + 0.5) / 10, table[:, 1] / np.maximum(table[:, 0], 1)
                error = np.sqrt(part * (1 - part) / np.maximum(table[:, 0], 1))
                line = {**_line(method, True), "markersize": 3.0}
                axis.errorbar(middle[some], part[some], yerr=error[some], label=TITLES[method], **line)
        axis.set(title=title, xlim=(0, 1), ylim=(0, 1), ylabel="part of the pixels of which it is true")
        axis.minorticks_on()
        axis.set_xlabel("probability given")
        axis.legend(loc="upper left")
        axis.label_outer()
    return save(figure, path, note=note)


# Parts


def _fit_height(figure: Figure, column: Sequence[Axes], ratio: float) -> None:
    """Gives a figure the height at which images above each other, whose width decides how large they are, fill their
    rows; `ratio`: of an image, its height over its width."""
    for _ in range(2):  # texts take the place that is left free in the first layout
        figure.draw_without_rendering()
        width, height = figure.get_size_inches()
        cells = [axis.get_position(original=True) for axis in column]
        figure.set_figheight(height + sum(ratio * width * cell.width - height * cell.height for cell in cells))


def _line(method: str, bold: bool) -> dict[str, Any]:
    _, colour, marker, line = METHODS[method]
    return {"color": colour, "marker": marker, "linestyle": line, "linewidth": 1.8 if bold else 1.0}


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
