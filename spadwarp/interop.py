"""Results as labelled arrays (xarray) and tables as data frames (pandas); both are optional."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from spadwarp.values import ArgumentError, FileError

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["Variable", "labelled", "to_pandas"]

Variable = tuple[tuple[str, ...], Any, str, str]
"""Dimensions, values, unit ("1" for a plain number) and meaning of an array."""


def labelled(
    variables: Mapping[str, Variable], coordinates: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> xarray.Dataset:
    """An xarray data set whose arrays have `units` and `long_name`. Raises `FileError` without xarray."""
    try:
        import xarray
    except ModuleNotFoundError as error:
        raise FileError("labelled arrays need xarray: pip install 'spadwarp[xarray]'") from error

    def array(variable: Variable) -> tuple[tuple[str, ...], Any, dict[str, str]]:
        dimensions, values, unit, meaning = variable
        return dimensions, values, {"units": unit, "long_name": meaning}

    return xarray.Dataset(
        {name: array(variable) for name, variable in variables.items()},
        coords={name: array(variable) for name, variable in coordinates.items()},
        attrs=dict(attributes),
    )


def to_pandas(rows: Iterable[Any] | Any) -> pandas.DataFrame:
    """Rows as a pandas DataFrame: a list of data classes or dicts, or a `Sweep`, whose values are the index.

    For what `spadwarp.budget`, `sweep`, `check`, `scene.presets` and `analytic.plan` give: `to_pandas(budget(scene))`.

    Raises:
        FileError: pandas is not installed.
        ArgumentError: Rows that are neither data classes nor dicts.
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise FileError("data frames need pandas: pip install 'spadwarp[xarray]'") from error
    index = None
    if hasattr(rows, "rows") and hasattr(rows, "values") and hasattr(rows, "field"):
        rows, index = rows.rows, pandas.Index(rows.values, name=rows.field)
    elif isinstance(rows, Mapping):
        rows = rows.values()
    table: list[Any] = [dataclasses.asdict(row) if dataclasses.is_dataclass(row) else row for row in rows]  # type: ignore[arg-type]
    if not all(isinstance(row, Mapping) for row in table):
        raise ArgumentError(f"rows hold a {type(table[0]).__name__}; data classes or dicts are needed")
    return pandas.DataFrame(table, index=index)
