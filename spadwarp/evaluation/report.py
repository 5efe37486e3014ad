"""The report of an evaluation: the paper's figures 9 to 13 and its table 4, as PNG and one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spadwarp.evaluation.datasets import LARGER_IS_BETTER, Evaluation
from spadwarp.evaluation.drawn_scenes import SceneScores
from spadwarp.io.paths import atomic_path
from spadwarp.io.text import json_text
from spadwarp.viz.evaluation import SCORES, TITLES, draw_ranking, draw_reliability, draw_samples, draw_scores
from spadwarp.viz.viewer import write_page

__all__ = ["TITLES", "scene_table", "write_report", "write_scene_report"]


_NBSP = "\N{NO-BREAK SPACE}"

# A title, the names of the columns, and rows of a name and cells, each a text and whether it is the best of its column.
_Table = tuple[str, list[str], list[tuple[str, list[tuple[str, bool]]]]]


def write_report(evaluation: Evaluation, folder: str | Path) -> list[Path]:
    """Writes `report.html`, its pictures and `scores.json` to a folder; returns the paths, the report first.

    Pictures: `metrics.png` (scores against the backscatter fraction, target by target; the paper's figure 9),
    `samples.png` (methods side by side; 10), `rescaled.png` (the same over the target's own depth; 11), `detail.png` (a
    part enlarged; 12), `ranking.png` (13). The table is the paper's table 4. Raises `FileError`.
    """
    place = Path(folder)
    pictures = _draw(evaluation, place)
    tables = [_means(evaluation), _gains(evaluation), *([_steps(evaluation)] if evaluation.steps else [])]
    frames = sum(evaluation.frames.values())
    texts = {"data": evaluation.data, "summary": evaluation.summary, "targets": evaluation.targets, "frames": frames}
    return _write(place, evaluation, pictures, tables, texts)


def scene_table(scores: SceneScores, setting: str, water: str) -> tuple[list[str], list[list[str]]]:
    """Names of the columns and rows of text for a scene type: gains by level, errors, pixels missed and invented."""
    names = ["method", *(f"{level:g}" for level in scores.levels()), "mean [dB]", "RMSE [mm]", "rim", "inside"]
    names += ["missed", "invented", "steps"]
    rows = []
    for method in scores.methods:
        where: dict[str, Any] = {"setting": setting, "water": water}
        field = "psnr" if method == "input" else "gain"
        form = "{:.1f}" if method == "input" else "{:+.1f}"
        cells = [form.format(scores.mean(field, method, level=level, **where)) for level in scores.levels()]
        cells.append(form.format(scores.mean(field, method, **where)))
        cells += [f"{scores.mean(name, method, **where):.0f}" for name in ("rmse_mm", "rim_mm", "inside_mm")]
        for name in ("missed", "invented"):
            value = scores.mean(name, method, **where)
            cells.append("–" if math.isnan(value) else f"{100 * value:.2f}{_NBSP}%")
        resolved, total = (scores.mean(name, method, shape="stairs", **where) for name in ("resolved", "steps"))
        cells.append("–" if math.isnan(total) else f"{resolved:.1f} of {total:.1f}")
        rows.append([TITLES[method], *cells])
    return names, rows


def write_scene_report(scores: SceneScores, folder: str | Path) -> list[Path]:
    """Writes `report.html`, `reliability.png` and `scores.json` to a folder; returns the paths, the report first.

    A table for each scene type, and how often the probabilities were true. Raises `FileError`.
    """
    picture = draw_reliability(scores.reliability, Path(folder) / "reliability.png")
    tables: list[_Table] = []
    for setting, water in scores.types():
        names, rows = scene_table(scores, setting, water)
        cells = [(name, [(text, False) for text in texts]) for name, *texts in rows]
        tables.append((f"{setting.capitalize()}, backscatter {water}: PSNR of the input, gains [dB]", names, cells))
    below = [method for (method, *_), one in scores.rows.items() if one.gain < 0]
    worse = ", ".join(f"{TITLES[name]} {below.count(name)}" for name in scores.methods[1:])
    texts = {
        "data": "Scenes that no training saw",
        "frames": len(scores.rows) // len(scores.methods),
        "targets": list(dict.fromkeys(key[4] for key in scores.rows)),
        "summary": f"All pixels count; frames whose PSNR is below the input's: {worse}",
    }
    return _write(Path(folder), scores, {"Probabilities given, and how often they were true": picture}, tables, texts)


def _write(
    place: Path,
    scores: Evaluation | SceneScores,
    pictures: dict[str, Path],
    tables: list[_Table],
    texts: dict[str, Any],
) -> list[Path]:
    """Writes the page and `scores.json`; the paths of all files."""
    with atomic_path(place / "scores.json") as temporary:
        temporary.write_text(json_text(scores.to_dict(), indent=1))
    encoded = [(title, base64.b64encode(path.read_bytes()).decode()) for title, path in pictures.items()]
    write_page(place / "report.html", "evaluation.html", tables=tables, pictures=encoded, **texts)
    return [place / "report.html", *pictures.values(), place / "scores.json"]


def _draw(evaluation: Evaluation, place: Path) -> dict[str, Path]:
    """The pictures by their titles."""
    scores = {key: dataclasses.asdict(scores) for key, scores in evaluation.scores.items()}
    means = {method: dataclasses.asdict(evaluation.mean(method)) for method in evaluation.ranking()}
    note, targets, levels = evaluation.summary, evaluation.targets, evaluation.levels
    named: dict[str, Any] = {"methods": evaluation.methods, "note": note}
    keys = [(target, level) for target in targets for level in dict.fromkeys((levels[len(levels) // 3], levels[-1]))]
    samples = [evaluation.samples[key] for key in keys if key in evaluation.samples]
    return {
        "Scores against the level, target by target (the paper's figure 9)": draw_scores(
            scores, place / "metrics.png", targets=targets, levels=levels, **named
        ),
        "Samples over the whole gate (figure 10)": draw_samples(samples, place / "samples.png", **named),
        "The same samples over the depth of their target (figure 11)": draw_samples(
            samples, place / "rescaled.png", rescaled=True, **named
        ),
        "A part of each sample, enlarged (figure 12)": draw_samples(
            samples, place / "detail.png", rescaled=True, enlarged=True, **named
        ),
        "Means over targets and levels (figure 13)": draw_ranking(
            means, place / "ranking.png", larger_is_better=LARGER_IS_BETTER, note=note
        ),
    }


def _means(evaluation: Evaluation) -> _Table:
    means = {method: dataclasses.asdict(evaluation.mean(method)) for method in evaluation.ranking()}
    best = {
        field: (max if larger else min)(values[field] for values in means.values())
        for field, larger in LARGER_IS_BETTER.items()
    }
    rows = []
    for method, values in means.items():
        cells = [(text.format(values[name]), values[name] == best.get(name)) for name, (_, text) in SCORES.items()]
        rows.append((TITLES[method], cells))
    title = "Ranking: means over targets and levels (the paper's table 4)"
    return title, ["method", *(name for name, _ in SCORES.values())], rows


def _gains(evaluation: Evaluation) -> _Table:
    """PSNR in dB and SSIM in percent above the input's."""

    def gain(method: str, level: str) -> str:
        if not any((method, target, level) in evaluation.scores for target in evaluation.targets):
            return "–"
        scores, before = evaluation.mean(method, level=level), evaluation.mean("input", level=level)
        if method == "input":
            return f"{scores.psnr:.2f}{_NBSP}dB, {scores.ssim:.3f}"
        ssim = 100 * (scores.ssim / before.ssim - 1)
        return f"{scores.psnr - before.psnr:+.2f}{_NBSP}dB, {ssim:+.0f}{_NBSP}%"

    title, names = "Gain over the noisy input, level by level", ["PSNR, SSIM", *evaluation.levels]
    windows = f" ({', '.join(map(str, evaluation.windows.values()))})"
    return title, names, _rows(evaluation, gain, {"median": windows})


def _steps(evaluation: Evaluation) -> _Table:
    def resolved(method: str, level: str) -> str:
        steps = evaluation.steps.get((method, level))
        return "–" if steps is None else f"{steps.resolved} of {steps.total}"

    title = "Steps of 10 cm of the staircase that are resolved to 3 cm"
    return title, ["method", *evaluation.levels], _rows(evaluation, resolved, {})


def _rows(
    evaluation: Evaluation, text: Callable[[str, str], str], suffixes: dict[str, str]
) -> list[tuple[str, list[tuple[str, bool]]]]:
    """A row for each method with the text of each level."""
    return [
        (TITLES[method] + suffixes.get(method, ""), [(text(method, level), False) for level in evaluation.levels])
        for method in evaluation.ranking()
    ]
