"""The report of an evaluation: the paper's figures 9 to 13 and its table 4, remade, as PNG and one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.denoise.evaluation import Evaluation, Sample
from spadwarp.denoise.metrics import LARGER_IS_BETTER
from spadwarp.io.atomic import atomic_path
from spadwarp.viz.pages import write_page

__all__ = ["COLOURS", "TITLES", "write_report"]

TITLES = {
    "input": "noisy input",
    "median": "median, best window",
    "gating": "backscatter gating",
    "bm3d": "BM3D",
    "usdn": "USDN",
    "dncnn": "DnCNN",
    "pyramid": "PyramidNet",
    "histograms": "PyramidNet, histograms",
}
COLOURS = {
    "input": "0.55",
    "median": "#E69F00",
    "gating": "#56B4E9",
    "bm3d": "#CC79A7",
    "usdn": "#009E73",
    "dncnn": "#D55E00",
    "pyramid": "#0072B2",
    "histograms": "black",
}
_FIELDS = {
    "psnr": ("PSNR [dB]", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "entropy": ("entropy [bit]", "{:.2f}"),
    "rmse_mm": ("RMSE [mm]", "{:.1f}"),
    "within_1cm": ("within 1 cm", "{:.1%}"),
    "within_5cm": ("within 5 cm", "{:.1%}"),
    "edge_mm": ("edge error [mm]", "{:.1f}"),
}
_DPI = 130


def write_report(evaluation: Evaluation, folder: str | Path) -> list[Path]:
    """Writes `report.html`, its pictures and `scores.json` to a folder; returns the paths, the report first.

    Pictures: `metrics.png` (scores against backscatter, target by target; the paper's figure 9), `samples.png`
    (methods side by side; 10), `rescaled.png` (the same over the target's own depth; 11), `detail.png` (a part
    enlarged; 12), `ranking.png` (13). The table is the paper's table 4. Raises `FileError`.
    """
    place = Path(folder)
    figures = {
        "metrics.png": ("Scores against backscatter, target by target (the paper's figure 9)", _metrics(evaluation)),
        "samples.png": ("Samples over the whole gate (figure 10)", _samples(evaluation)),
        "rescaled.png": (
            "The same samples over the depth of their target (figure 11)",
            _samples(evaluation, tight=True),
        ),
        "detail.png": ("A part of each, enlarged (figure 12)", _samples(evaluation, tight=True, enlarged=True)),
        "ranking.png": ("Means over targets and levels (figure 13)", _ranking(evaluation)),
    }
    written = []
    for name, (_, figure) in figures.items():
        with atomic_path(place / name) as temporary:
            figure.savefig(temporary, dpi=_DPI, format="png")
        written.append(place / name)
    with atomic_path(place / "scores.json") as temporary:
        temporary.write_text(json.dumps(_plain(evaluation.to_dict()), indent=1) + "\n")
    tables = [_ranking_table(evaluation), _gain_table(evaluation)]
    if evaluation.steps:
        tables.append(_step_table(evaluation))
    write_page(
        place / "report.html",
        "evaluation.html",
        data=evaluation.data,
        frames=sum(evaluation.frames.values()),
        targets=evaluation.targets,
        about=evaluation.about,
        tables=tables,
        pictures=[
            (title, base64.b64encode((place / name).read_bytes()).decode()) for name, (title, _) in figures.items()
        ],
    )
    return [place / "report.html", *written, place / "scores.json"]


# Figures


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _metrics(evaluation: Evaluation) -> Any:
    fields = ("psnr", "ssim", "entropy", "rmse_mm")
    targets = evaluation.targets
    width = max(3.1 * len(targets) + 1.0, 5.2)
    figure = _figure(width, 2.3 * len(fields) + 0.9)
    axes = figure.subplots(len(fields), len(targets), squeeze=False, sharex=True, sharey="row")
    places, labels = _level_axis(evaluation)
    lines: dict[str, Any] = {}
    for column, target in enumerate(targets):
        for row, field in enumerate(fields):
            axis = axes[row, column]
            for method in evaluation.methods:
                points = [
                    (x, getattr(evaluation.scores[method, target, level], field))
                    for x, level in zip(places, evaluation.levels, strict=True)
                    if (method, target, level) in evaluation.scores
                ]
                if points:
                    bold = method == "pyramid"
                    (lines[method],) = axis.plot(
                        *zip(*points, strict=True), color=COLOURS[method], marker="o", markersize=3.5,
                        linewidth=2.2 if bold else 1.2, zorder=3 if bold else 2,
                        linestyle="--" if method == "input" else "-",
                    )  # fmt: skip
            if field == "rmse_mm":
                axis.set_yscale("log")
            axis.grid(color="0.92")
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
            if row == 0:
                axis.set_title(target.replace("_", " "), fontsize=11)
            if column == 0:
                axis.set_ylabel(_FIELDS[field][0])
            if row == len(fields) - 1:
                axis.set_xticks(places, labels, fontsize=8)
                axis.set_xlabel(_level_name(evaluation))
    names = [TITLES[name] for name in lines]
    columns = min(len(names), int(width / 1.7))  # 1.7 inches hold the longest name and its line
    figure.legend(list(lines.values()), names, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
    _stated(figure, evaluation.about)
    return figure


def _samples(evaluation: Evaluation, *, tight: bool = False, enlarged: bool = False) -> Any:
    """A row for each target at a middle level and at the highest; truth, then the methods."""
    levels = list(dict.fromkeys((evaluation.levels[len(evaluation.levels) // 3], evaluation.levels[-1])))
    keys = [(t, at) for t in evaluation.targets for at in levels if (t, at) in evaluation.samples]
    methods = [name for name in evaluation.methods if any(name in evaluation.samples[key].images for key in keys)]
    columns = 1 + len(methods)
    first = evaluation.samples[keys[0]].clean
    ratio = 1.0 if enlarged else first.shape[0] / first.shape[1]
    figure = _figure(2.05 * columns + 0.7, (2.05 * ratio + 0.34) * len(keys) + 0.5)
    axes = figure.subplots(len(keys), columns, squeeze=False)
    for row, key in enumerate(keys):
        sample = evaluation.samples[key]
        rows, cols = _detail(sample) if enlarged else (slice(None), slice(None))
        low, high = _limits(sample, rows, cols) if tight else sample.gate
        shown = {"truth": sample.clean, **{name: sample.images.get(name) for name in methods}}
        for axis, (name, image) in zip(axes[row], shown.items(), strict=True):
            axis.set_xticks([])
            axis.set_yticks([])
            for spine in axis.spines.values():
                spine.set_color("0.8")
            if image is None:
                axis.text(0.5, 0.5, "not run", ha="center", va="center", color="0.5", transform=axis.transAxes)
                continue
            visible = np.where(np.isfinite(sample.clean) | (name == "input"), image, np.nan)[rows, cols]
            drawn = axis.imshow(visible, cmap=_colours(), vmin=low, vmax=high, interpolation="nearest")
            if row == 0:
                axis.set_title("truth" if name == "truth" else TITLES[name], fontsize=9)
        bar = figure.colorbar(drawn, ax=list(axes[row]), fraction=0.02, pad=0.01)
        bar.set_label("depth z [m]", fontsize=8)
        bar.ax.tick_params(labelsize=7)
        bar.outline.set_visible(False)
        caption = axes[row, 0].text(0.0, -0.04, sample.about, fontsize=7.5, va="top", transform=axes[row, 0].transAxes)
        caption.set_in_layout(False)  # runs on below the other images
    figure.get_layout_engine().set(hspace=0.1)
    _stated(figure, f"grey: no target; {evaluation.about}")
    return figure


def _ranking(evaluation: Evaluation) -> Any:
    fields = ("psnr", "ssim", "rmse_mm", "edge_mm")
    order = evaluation.ranking()[::-1]
    figure = _figure(12.0, 0.42 * len(order) + 1.5)
    for axis, field in zip(figure.subplots(1, len(fields), sharey=True), fields, strict=True):
        values = [getattr(evaluation.mean(method), field) for method in order]
        axis.barh(range(len(order)), values, color=[COLOURS[one] for one in order], height=0.7)
        for y, value in enumerate(values):
            axis.text(value, y, " " + _FIELDS[field][1].format(value), va="center", fontsize=8)
        axis.set_yticks(range(len(order)), [TITLES[one] for one in order])
        axis.set_xlim(0, 1.25 * max(values))
        axis.set_xlabel(_FIELDS[field][0] + (" (more is better)" if LARGER_IS_BETTER[field] else " (less is better)"))
        axis.spines[["top", "right"]].set_visible(False)
    _stated(figure, evaluation.about)
    return figure


def _stated(figure: Any, text: str) -> None:
    width = int(14 * figure.get_figwidth())  # characters of this size
    figure.supxlabel(textwrap.fill(text, width), fontsize=8, color="0.35")


def _colours() -> Any:
    import matplotlib

    return matplotlib.colormaps["viridis_r"].with_extremes(bad="0.85")


def _limits(sample: Sample, rows: slice, columns: slice) -> tuple[float, float]:
    part = sample.clean[rows, columns]
    part = part[np.isfinite(part) & (part < sample.gate[1])]
    low, high = (float(part.min()), float(part.max())) if part.size else sample.gate
    return low - 0.05 * (high - low) - 0.01, high + 0.05 * (high - low) + 0.01


def _detail(sample: Sample) -> tuple[slice, slice]:
    """A square of a quarter of the height where the truth has most edges."""
    clean = np.nan_to_num(sample.clean, nan=sample.gate[1] + 0.5)
    busy = np.minimum(np.abs(np.diff(clean, axis=0))[:, :-1] + np.abs(np.diff(clean, axis=1))[:-1], 0.3)
    side = max(16, sample.clean.shape[0] // 4)
    total = np.pad(busy.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    row, column = np.unravel_index(int(sums.argmax()), sums.shape)
    return slice(int(row), int(row) + side), slice(int(column), int(column) + side)


def _level_axis(evaluation: Evaluation) -> tuple[list[float], list[str]]:
    """Where levels stand on an axis, and their labels."""
    if _level_name(evaluation).startswith("BS"):
        return [float(level) for level in evaluation.levels], [level.lstrip("0") for level in evaluation.levels]
    return [float(k) for k in range(len(evaluation.levels))], [
        one.removesuffix(" photons") for one in evaluation.levels
    ]


def _level_name(evaluation: Evaluation) -> str:
    counted = any("photons" in level for level in evaluation.levels)
    return "signal photons a pixel" if counted else "BS, part of pixels that report backscatter"


# Tables: a title, the names of the columns, and rows of a name and cells (text, whether it is the best)

_Table = tuple[str, list[str], list[tuple[str, list[tuple[str, bool]]]]]


def _ranking_table(evaluation: Evaluation) -> _Table:
    means = {method: dataclasses.asdict(evaluation.mean(method)) for method in evaluation.methods}
    best = {
        field: (max if larger else min)(values[field] for values in means.values())
        for field, larger in LARGER_IS_BETTER.items()
    }
    rows = []
    for method in evaluation.ranking():
        cells = [
            (template.format(means[method][field]), means[method][field] == best.get(field))
            for field, (_, template) in _FIELDS.items()
        ]
        rows.append((TITLES[method], cells))
    title = "Ranking: means over targets and levels (the paper's table 4)"
    return title, ["method", *(name for name, _ in _FIELDS.values())], rows


def _gain_table(evaluation: Evaluation) -> _Table:
    """PSNR in dB and SSIM in percent above the input's."""
    rows = []
    for method in evaluation.ranking():
        cells = []
        for level in evaluation.levels:
            if not any(key[0] == method and key[2] == level for key in evaluation.scores):
                cells.append(("–", False))
                continue
            one, before = evaluation.mean(method, level=level), evaluation.mean("input", level=level)
            if method == "input":
                cells.append((f"{one.psnr:.2f}\N{NO-BREAK SPACE}dB, {one.ssim:.3f}", False))
            else:
                ssim = 100 * (one.ssim / before.ssim - 1)
                cells.append(
                    (f"{one.psnr - before.psnr:+.2f}\N{NO-BREAK SPACE}dB, {ssim:+.0f}\N{NO-BREAK SPACE}%", False)
                )
        window = " (" + ", ".join(map(str, evaluation.windows.values())) + ")" if method == "median" else ""
        rows.append((TITLES[method] + window, cells))
    return "Gain over the noisy input, level by level", ["PSNR, SSIM", *evaluation.levels], rows


def _step_table(evaluation: Evaluation) -> _Table:
    rows = []
    for method in evaluation.ranking():
        found = [evaluation.steps.get((method, level)) for level in evaluation.levels]
        rows.append(
            (TITLES[method], [("–" if one is None else f"{one.resolved} of {one.total}", False) for one in found])
        )
    return "Steps of 10 cm that the staircase's frames resolve to 3 cm", ["method", *evaluation.levels], rows


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
