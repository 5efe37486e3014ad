"""Tables of numbers for people, and as CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.analytic import BudgetRow
    from spadwarp.scene import Scene


def budget_table(names: Sequence[str], title: str, found: Sequence[BudgetRow]) -> Table:
    from spadwarp.analytic import OUTLIERS

    table = new_table(
        title,
        "range\n[m]",
        "c·r",
        "gate [ns]",
        "pulses",
        "signal",
        "background",
        "α",
        "signal/\nbackscatter",
        "σ* [ps]",
        "σ* [mm]",
        "outliers",
        "pulses\nfor 1 cm",
    )
    before = None
    for name, row in zip(names, found, strict=True):
        reached = row.outlier_probability <= OUTLIERS
        table.add_row(
            name if name != before else "",
            f"{row.range:.4g}",
            f"{row.optical_depth:.3g}",
            f"{1e9 * row.gate_start:.4g}-{1e9 * row.gate_stop:.4g}{'*' if row.gate_moved else ' '}",
            f"{row.pulses:.3g}",
            f"{row.signal:.3g}",
            f"{row.background:.3g}",
            f"{row.alpha:.3g}",
            short(row.signal_to_backscatter),
            bracketed(1e12 * row.sigma_time, reached),
            bracketed(1e3 * row.sigma_depth, reached),
            percent(row.outlier_probability),
            "never" if math.isinf(row.pulses_for_1cm) else f"{row.pulses_for_1cm:.3g}",
        )
        before = name
    return table


def table_notes(found: Sequence[BudgetRow], scene: Scene) -> list[str]:
    """What the columns of a budget do not say by themselves."""
    notes = []
    if any(row.gate_moved for row in found):
        gate = scene.gate
        notes.append(
            f"* not the scene's gate, {gate.start_ns:.4g}-{gate.stop * 1e9:.4g} ns, which misses the return of one of "
            "the ranges, but one as long around the return"
        )
    own, detector = scene.analytic.pulses_per_depth_frame, scene.detector.pulses_per_frame
    if scene.analytic.count_law == "per_pulse" and own is not None and own != detector:
        notes.append(
            f"pulses: analytic.pulses_per_depth_frame = {own}; without it, detector.pulses_per_frame = {detector} "
            "would count"
        )
    return notes


def new_table(first: str, *titles: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(first, no_wrap=True)
    for title in titles:
        table.add_column(title, justify="right", no_wrap=True)
    return table


def short(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "∞" if math.isinf(value) else f"{value:.3g}"


def bracketed(value: float, reached: bool) -> str:
    text = short(value)
    return text if reached or text == "-" else f"({text})"


def percent(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "< 0.001 %" if 0 < value < 1e-5 else f"{100 * value:.3g} %"
