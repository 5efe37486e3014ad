"""What a check finds."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np

__all__ = ["CheckMessage", "note", "span", "vector", "warning"]


@dataclasses.dataclass(frozen=True)
class CheckMessage:
    """One finding: `warning` if the run will not show what the scene asks for, `note` if one should know it.

    `field` names the place in the scene, `values` the numbers in `text` (units as in the text).
    """

    level: Literal["warning", "note"]
    field: str
    text: str
    values: dict[str, float] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.level}: {self.field}: {self.text}"


def warning(field: str, text: str, **values: float) -> CheckMessage:
    """A warning."""
    return CheckMessage("warning", field, text, values)


def note(field: str, text: str, **values: float) -> CheckMessage:
    """A note."""
    return CheckMessage("note", field, text, values)


def span(low: float, high: float) -> str:
    """`1.5 to 3`"""
    return f"{low:.4g} to {high:.4g}"


def vector(values: Any) -> str:
    """`(0, 1, 2.5)`"""
    return "(" + ", ".join(f"{value:.4g}" for value in np.asarray(values)) + ")"
