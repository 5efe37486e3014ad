"""How the speed of the cases changed from release to release: a picture of the reports in a folder.

python bench/history.py

Each panel is a case. A point is one report: its speed over that of the first report from the same kind of device, with
the slowest and the fastest of the timed runs. The number is the newest rate.
"""

import argparse
import datetime
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from spadwarp.benchmark import CASES, history
from spadwarp.viz import style

RESULTS = Path(__file__).parent / "results"
Point = tuple[datetime.date, float, float, float]  # date; slowest, mean and fastest rate [1/s]


def rates(directory: Path) -> tuple[dict[str, dict[str, list[Point]]], dict[str, str]]:
    """Case → device → points in the order of time; case → unit."""
    found: dict[str, dict[str, list[Point]]] = defaultdict(lambda: defaultdict(list))
    units: dict[str, str] = {}
    for _, stored in history(directory):
        made = stored["provenance"]
        date = datetime.date.fromisoformat(made["date"][:10])
        for row in stored["results"]:
            if row["case"] in CASES:
                unit = units[row["case"]] = next(iter(row["rates"]))
                each = row["size"][unit] / np.array(row["seconds"])
                point = date, float(each.min()), float(np.exp(np.log(each).mean())), float(each.max())
                found[row["case"]][device_of(made)].append(point)
    return {case: dict(found[case]) for case in CASES if case in found}, units


def device_of(made: dict[str, Any]) -> str:
    threads = made["threads"]
    name = str(made["device_name"])
    return name if threads is None else f"{name}, {threads} thread{'s' * (threads > 1)}"


def draw_case(axis: Axes, points: dict[str, list[Point]], unit: str, colours: dict[str, str]) -> None:
    axis.axhline(1.0, color="0.7", linewidth=0.6)
    for number, (device, line) in enumerate(points.items()):
        date = [point[0] for point in line]
        low, mean, high = np.array([point[1:] for point in line]).T
        first = mean[0]
        spread = np.maximum([mean - low, high - mean], 0.0) / first
        axis.errorbar(date, mean / first, yerr=spread, fmt="o-", color=colours[device], label=device)
        axis.annotate(
            f"{mean[-1]:.3g} {unit}/s",
            (0.04, 0.96 - 0.1 * number),
            xycoords="axes fraction",
            va="top",
            size=6.5,
            color=colours[device],
        )


@style.paper()
def draw(directory: Path, path: Path) -> None:
    """Writes the picture."""
    cases, units = rates(directory)
    devices = list(dict.fromkeys(device for points in cases.values() for device in points))
    colours = dict(zip(devices, style.SERIES, strict=False))
    columns = 4
    rows = -(-len(cases) // columns)
    figure = style.new_figure(style.PAGE, 1.35 * rows + 0.45)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis in axes.ravel()[len(cases) :]:
        axis.remove()
    for axis, (case, points) in zip(axes.ravel(), cases.items(), strict=False):
        draw_case(axis, points, units[case], colours)
        axis.set(title=case)
        style.plain_axis(axis)
    days = sorted({point[0] for points in cases.values() for line in points.values() for point in line})
    shown = sorted({days[0], days[-1]})  # a third date would touch its neighbours
    axes[0, 0].set_xticks(shown, labels=[f"{day:%Y-%m-%d}" for day in shown])
    axes[0, 0].margins(x=0.25)
    low, high = axes[0, 0].get_ylim()
    axes[0, 0].set(ylim=(min(low, 0.75), max(high, 1.15)))
    figure.supylabel("speed over that of the first report", size=8)
    handles = [figure.axes[0].plot([], [], "o-", color=colours[device], label=device)[0] for device in devices]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    style.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path, nargs="?", default=RESULTS, help="reports of `spadwarp bench --json`")
    parser.add_argument("--out", type=Path, help="the picture to write; history.png in the directory")
    options = parser.parse_args()
    draw(options.directory, options.out or options.directory / "history.png")


if __name__ == "__main__":
    main()
