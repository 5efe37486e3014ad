"""Tables of numbers for people, and as CSV."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column, Table

    from spadwarp.analytic import BudgetRow
    from spadwarp.scene import Scene

_SCATTERS = 0.2  # optical depth: from here on scattered light adds more than a quarter to a target's


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
            counted(row.pulses),
            f"{row.signal:.3g}",
            f"{row.background:.3g}",
            f"{row.alpha:.3g}",
            short(row.signal_to_backscatter),
            bracketed(1e12 * row.sigma_time, reached),
            bracketed(1e3 * row.sigma_depth, reached),
            percent(row.outlier_probability),
            "never" if math.isinf(row.pulses_for_1cm) else counted(row.pulses_for_1cm),
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
    if any(row.optical_depth > _SCATTERS for row in found):
        notes.append(
            "signal: unscattered light alone. In water that scatters, more light comes back from a target: in a view "
            "of 10° of a plane at 5 m, in water of albedo 0.83 and anisotropy 0.924, 1.3 times as much at c·r = 0.2 "
            "and 3.6 times at 1; `spadwarp plan` traces all of it"
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


def parts(table: Table, console: Console, keys: int) -> list[Table]:
    """The table if it is not wider than the console or can break its lines, else parts of it that are not.

    Each part begins with the first `keys` columns.
    """
    widest = console.options.update(width=10_000)

    def part(columns: Sequence[Column]) -> Table:
        chosen = copy.copy(table)
        chosen.columns = [dataclasses.replace(column, _index=i) for i, column in enumerate(columns)]
        return chosen

    def fits(columns: Sequence[Column]) -> bool:
        return console.measure(part(columns), options=widest).maximum <= console.width

    if not all(column.no_wrap for column in table.columns) or fits(table.columns):
        return [table]
    first, groups = table.columns[:keys], [table.columns[keys : keys + 1]]
    for column in table.columns[keys + 1 :]:
        if fits([*first, *groups[-1], column]):
            groups[-1].append(column)
        else:
            groups.append([column])
    return [part([*first, *group]) for group in groups]


def counted(value: float) -> str:
    """A number of pulses to three digits: 5 300, 1.2e+07."""
    if not 100.0 <= value < 1e7:
        return short(value)
    return f"{float(f'{value:.3g}'):,.0f}".replace(",", " ")


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
