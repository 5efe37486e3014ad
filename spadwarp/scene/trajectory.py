"""Scenes that move: fields of a scene by time, from a table."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError
from spadwarp.io.text import read_text
from spadwarp.limits import check_integer, check_real, read_real, shown
from spadwarp.scene.pose import rotation_angles
from spadwarp.scene.scene import Scene

__all__ = ["Trajectory", "load_trajectory"]

_MOST_ROWS = 1_000_000
_ANGLES = re.compile(r"^(.*rotation_deg)\[([012])\]$")


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """Values of fields of a scene at ascending times.

    Attributes:
        times: [s], `[N]`.
        fields: Fields as overrides name them, such as `camera.position[0]` or `targets[1].translation[2]`.
        values: `[N, fields]`, in the units of the fields.
        source: The file that they came from.
    """

    times: NDArray[np.float64]
    fields: tuple[str, ...]
    values: NDArray[np.float64]
    source: str | None = None

    def __len__(self) -> int:
        return len(self.times)

    def scene(self, base: Scene, row: int) -> Scene:
        """The scene at a row. Raises `ConfigError` for a field that it does not have, or a value out of range."""
        try:
            return base.with_overrides(dict(zip(self.fields, map(float, self.values[row]), strict=True)))
        except ConfigError as error:
            place = f"row {row + 1}, time {self.times[row]:g} s"
            raise ConfigError([f"{place}: {text}" for text in error.problems], source=self.source) from None

    def scenes(self, base: Scene) -> Iterator[Scene]:
        """The scene at each row."""
        return (self.scene(base, row) for row in range(len(self)))

    def sampled(self, frame_rate: float) -> Trajectory:
        """The trajectory at even times from its first to its last, `frame_rate` a second.

        Values in between are linear; the three angles of a `rotation_deg` together are those of the shortest turn.
        """
        check_real("frame_rate", frame_rate, "[1e-6, 1e12]")
        span = float(self.times[-1] - self.times[0])
        count = check_integer(
            "frames of the trajectory", int(span * frame_rate * (1 + 1e-12)) + 1, f"[1, {_MOST_ROWS}]"
        )
        times = np.minimum(self.times[0] + np.arange(count) / frame_rate, self.times[-1])
        values = np.stack([np.interp(times, self.times, column) for column in self.values.T], axis=1)
        for columns in _rotations(self.fields):
            values[:, columns] = _turned(times, self.times, self.values[:, columns])
        return Trajectory(times=times, fields=self.fields, values=values, source=self.source)


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Reads a .csv file: a line of names, `time` [s] first and then fields of the scene, and a row for each pose.

    Fields are named as `--set` names them, with one number each: `camera.position[0]`, `camera.rotation_deg[1]`,
    `laser.position[2]`, `targets[0].translation[2]`. Lines that begin with # are passed over.

    Raises:
        FileError: The file cannot be read.
        ConfigError: No such table, a number that is not finite, or times that do not ascend.
    """
    lines = csv.reader(io.StringIO(read_text(path), newline=""))
    names: tuple[str, ...] = ()
    rows: list[list[float]] = []
    try:
        for cells in lines:
            if not cells or cells[0].lstrip().startswith("#"):
                continue
            if not names:
                names = _names(cells)
                continue
            if len(cells) != len(names):
                raise ValueError(f"{len(cells)} values for {len(names)} names")
            row = [read_real(name, cell, "[-1e19, 1e19]") for name, cell in zip(names, cells, strict=True)]
            if rows and not row[0] > rows[-1][0]:
                raise ValueError(f"time = {row[0]:g} is not after {rows[-1][0]:g}")
            rows.append(row)
            if len(rows) > _MOST_ROWS:
                raise ValueError(f"more than {_MOST_ROWS} rows")
        if not rows:
            raise ValueError("no row of numbers")
    except (ValueError, csv.Error) as error:
        raise ConfigError(f"line {lines.line_num}: {error}", source=str(path)) from None
    table = np.array(rows, np.float64)
    return Trajectory(times=table[:, 0], fields=names[1:], values=table[:, 1:], source=str(Path(path)))


def _names(cells: list[str]) -> tuple[str, ...]:
    names = tuple(cell.strip() for cell in cells)
    if names[0] != "time" or len(names) < 2:
        raise ValueError(f"{shown(','.join(names))} is not time and names of fields, such as time,camera.position[0]")
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{shown(twice)} is there twice")
    return names


def _rotations(fields: tuple[str, ...]) -> Iterator[list[int]]:
    """Columns of the angles of each rotation of which all three are given."""
    found: dict[str, dict[str, int]] = {}
    for column, name in enumerate(fields):
        if match := _ANGLES.match(name):
            found.setdefault(match[1], {})[match[2]] = column
    return ([columns[axis] for axis in "012"] for columns in found.values() if len(columns) == 3)


def _turned(times: NDArray[np.float64], known: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation, Slerp

    if len(known) < 2:
        return np.repeat(angles, len(times), axis=0)
    turns = Slerp(known, Rotation.from_euler("XYZ", angles, degrees=True))(times)
    return np.array([rotation_angles(matrix) for matrix in turns.as_matrix()])
