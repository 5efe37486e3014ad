"""Figures of a comparison of denoisers, and RMSE against photons: plain tables in, pictures out, as wide as a page.

Scores come as `{(method, target, level): {field: value}}`, samples as tuples of true depth `[H, W]` [m], gate [m],
depth by method and a caption. A level is a backscatter fraction, the part of the pixels that report backscatter, or a
range of photon counts. `note` is written below a picture; all return the picture's path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from spadwarp.viz import style
from spadwarp.viz.style import PAGE, PaperFigure, log_axis, panel_grid, paper, save, wrapped

METHODS = {
    "input": ("noisy input", "0.5", "x", "--"),
    "median": ("median, best window", style.ORANGE, "s", "-."),
    "gating": ("backscatter gating", style.SKY, "v", "-"),
    "bm3d": ("BM3D", style.PURPLE, "D", "-"),
    "usdn": ("USDN", style.GREEN, "^", "-"),
    "dncnn": ("DnCNN", style.RED, "P", "-"),
    "pyramid": ("PyramidNet", style.BLUE, "o", "-"),
    "own": ("your weights", "#AA4499", "X", "-"),
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
) -> Path:
    """Scores against the level, target by target; wider where there are too many targets for a page."""
    fields = ("psnr", "ssim", "entropy", "rmse_mm")
    width = max(PAGE, 1.3 * len(targets) + 0.6)
    figure = style.new_figure(width, 1.45 * len(fields) + 0.75)
    axes = figure.subplots(len(fields), len(targets), squeeze=False, sharex=True, sharey="row")
    counted = any("photons" in level for level in levels)
    places = [float(k) for k in range(len(levels))] if counted else [float(level) for level in levels]
    labels = [level.removesuffix(" photons") for level in levels]
    every = -(-len(labels) // max(2, int((width - 0.6) / len(targets) / 0.4)))
    for column, target in enumerate(targets):
        for axis, field in zip(axes[:, column], fields, strict=True):
            for method in methods:
                keys = [(x, (method, target, level)) for x, level in zip(places, levels, strict=True)]
                if points := [(x, scores[key][field]) for x, key in keys if key in scores]:
                    bold = method == "pyramid"
                    axis.plot(*zip(*points, strict=True), **_line(method, bold), zorder=2 + bold)
            style.plain_axis(axis)
        axes[0, column].set_title(target.replace("_", " "))
        axes[-1, column].set_xticks(places[::every], labels[::every])
        axes[-1, column].set_xlabel(wrapped("signal photons per pixel" if counted else "backscatter fraction", 1.25))
    for axis, field in zip(axes[:, 0], fields, strict=True):
        axis.set_ylabel(SCORES[field][0])
    log_axis(axes[-1, 0], "y")
    figure.key(axes.ravel(), 1.75, place="upper")
    figure.note(note)
    return save(figure, path)


@paper()
def draw_samples(
    samples: Sequence[Sample],
    path: str | Path,
    *,
    methods: Sequence[str],
    note: str,
    rescaled: bool = False,
    enlarged: bool = False,
) -> Path:
    """A row for each sample: truth, then the methods; wider where there are too many methods for a page.

    Grey: neither the truth nor the method sees a target. Black: a target is missed. Red: a target is invented. The
    note explains those that there are.
    `rescaled`: colours over the depth of the target, not over the gate. `enlarged`: only the part with most edges.
    """
    methods = [name for name in methods if any(name in images for _, _, images, _ in samples)]
    cell = max((PAGE - 0.5) / (1 + len(methods)), 0.8)
    height, across = samples[0][0].shape
    ratio = 1.0 if enlarged else height / across
    figure = style.new_figure(cell * (1 + len(methods)) + 0.5, (cell * ratio + 0.28) * len(samples) + 0.75)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.02)  # type: ignore[call-arg,union-attr]
    axes = figure.subplots(len(samples), 1 + len(methods), squeeze=False)
    for axis, title in zip(axes[0], ["truth", *(TITLES[name] for name in methods)], strict=True):
        axis.set_title(wrapped(title, cell - 0.05, size=7), fontsize=7)
    marks: set[str] = set()
    for row, (clean, gate, images, caption) in zip(axes, samples, strict=True):
        part = _detail(clean, gate) if enlarged else (slice(None), slice(None))
        target = np.isfinite(clean) & (clean < gate[1])
        low, high = style.shown_limits(np.where(target, clean, np.nan)[part], margin=0.05) if rescaled else gate
        for axis, (name, image) in zip(row, [("truth", clean), *((n, images.get(n)) for n in methods)], strict=True):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_color("0.8")
            if image is None:
                style.middle_text(axis, "not run", color="0.5")
                continue
            shown = np.where(target, image, np.nan)[part]
            drawn = axis.imshow(shown, cmap=style.colour_map(style.DEPTH_MAP), vmin=low, vmax=high)
            found = np.isfinite(image)
            missed, invented = (target & ~found)[part], (found & ~target)[part]
            if name != "truth":
                style.mark_pixels(axis, missed, invented)
                marks |= {text for text, of in ((_MISSED, missed), (_INVENTED, invented)) if of.any()}
            marks |= {_NO_TARGET} if not (found | target)[part].all() else set()
        bar = figure.colorbar(drawn, ax=list(row), fraction=0.02, pad=0.01)
        bar.set_label("depth z [m]", fontsize=7)
        bar.ax.locator_params(axis="y", nbins=4)
        bar.ax.tick_params(labelsize=6)
        bar.outline.set_visible(False)
        row[0].set_xlabel(" ", fontsize=6.5)  # the place of the caption, which may extend below the other images
        text = row[0].text(0.0, -0.02, caption, fontsize=6.5, va="top", transform=row[0].transAxes)
        text.set_in_layout(False)
    _fit_height(figure, list(axes[:, 0]), ratio)
    figure.note("; ".join([*(text for text in _MARKS if text in marks), note]))
    return save(figure, path)


def _fit_height(figure: PaperFigure, column: Sequence[Axes], ratio: float) -> None:
    """Gives a figure the height at which images above each other, whose width decides how large they are, fill their
    rows; `ratio`: of an image, its height over its width."""
    for _ in range(2):  # texts take the place that is left free in the first layout
        figure.draw_without_rendering()
        width, height = figure.get_size_inches()
        cells = [axis.get_position(original=True) for axis in column]
        figure.grow(sum(ratio * width * cell.width - height * cell.height for cell in cells))


@paper()
def draw_ranking(
    means: Mapping[str, Mapping[str, float]], path: str | Path, *, larger_is_better: Mapping[str, bool], note: str
) -> Path:
    """Mean scores `{method: {field: value}}` as bars, the first method on top."""
    fields = ("psnr", "ssim", "rmse_mm", "edge_mm")
    order = list(means)[::-1]
    figure, axes = panel_grid(4, PAGE, least=1.6, height=0.24 * len(order) + 0.65, sharey=True)
    for axis, field in zip(axes, fields, strict=True):
        title, form = SCORES[field]
        values = [means[method][field] for method in order]
        axis.grid(False)
        bars = axis.barh([TITLES[method] for method in order], values, height=0.7)
        for bar, method in zip(bars, order, strict=True):
            bar.set_color(METHODS[method][1])
        axis.bar_label(bars, [form.format(value) for value in values], padding=2, fontsize=6.5)
        axis.set_xlim(0, 1.45 * max(values))
        axis.locator_params(axis="x", nbins=3)
        axis.set_xlabel(f"{title}\n({'more' if larger_is_better[field] else 'less'} is better)")
    figure.note(note)
    return save(figure, path)


@paper()
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

    One panel for each signal-to-background ratio (SBR), `[S]`.
    """
    figure, axes = panel_grid(len(sbr), PAGE, least=1.6, height=2.3, more=0.4, sharex=True, sharey=True)
    for row, (axis, ratio) in enumerate(zip(axes, sbr, strict=True)):
        for name, values in rmse.items():
            label = {"label": "likelihood of each pixel"} if name == "input" else {}
            axis.plot(photons, 1e3 * values[row], **_line(name, name == "histograms") | label)
        axis.plot(photons, 1e3 * bound[row], color="black", linestyle=":", label="Cramér–Rao bound of a pixel")
        axis.set(xscale="log", yscale="log", title=f"signal to background {ratio:g}")
        axis.set(xlabel="signal photons per pixel", ylabel="RMSE of depth [mm]")
        axis.label_outer()
    for axis in axes:
        log_axis(axis, "x", most=4)
        log_axis(axis, "y")
    figure.key(axes, 1.75, place="upper")
    figure.note(note)
    return save(figure, path)


@paper()
def draw_reliability(tables: Mapping[tuple[str, str], NDArray[np.int64]], path: str | Path) -> Path:
    """How often it was true, against the probability that was given, by tenths.

    `tables`: by method and what the probability is of, pixels and those of which it was true, `[10, 2]`. A bar is the
    standard error of a part of so many pixels, taken as independent.
    """
    figure, axes = panel_grid(2, PAGE, least=2.8, height=2.8, more=0.2, sharex=True, sharey=True)
    kinds = {"target": "the pixel sees a target", "confidence": "its depth is right to 1 % of the gate"}
    for axis, (kind, title) in zip(axes, kinds.items(), strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linestyle=":", label="exactly right")
        for method, table in ((method, table) for (method, of), table in tables.items() if of == kind):
            pixels = np.maximum(table[:, 0], 1)
            some, part = table[:, 0] >= 20, table[:, 1] / pixels
            error = np.sqrt(part * (1 - part) / pixels)
            middle = (np.arange(10) + 0.5) / 10
            axis.errorbar(middle[some], part[some], yerr=error[some], **_line(method, True), markersize=3.0)
        axis.set(title=title, xlim=(0, 1), ylim=(0, 1), ylabel="part of the pixels of which it is true")
        axis.minorticks_on()
        axis.set_xlabel("probability given")
        axis.label_outer()
    axes[0].legend(loc="best")
    figure.note("scenes that no training saw")
    return save(figure, path)


def _line(method: str, bold: bool) -> dict[str, Any]:
    title, colour, marker, line = METHODS[method]
    return {"label": title, "color": colour, "marker": marker, "linestyle": line, "linewidth": 1.8 if bold else 1.0}


def _detail(clean: NDArray[np.float32], gate: tuple[float, float]) -> tuple[slice, slice]:
    """A square of a quarter of the height where the truth has most edges."""
    depth = np.nan_to_num(clean, nan=gate[1] + 0.5)
    edges = np.minimum(np.abs(np.diff(depth, axis=0))[:, :-1] + np.abs(np.diff(depth, axis=1))[:-1], 0.3)
    side = max(16, clean.shape[0] // 4)
    total = np.pad(edges.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    row, column = map(int, np.unravel_index(int(sums.argmax()), sums.shape))
    return slice(row, row + side), slice(column, column + side)
