"""Distributions of a recipe, and what all its tables have in common."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from spadwarp.errors import ArgumentError
from spadwarp.limits import check_real, shown
from spadwarp.scene.sections import listed

__all__ = [
    "Angle",
    "Distribution",
    "Names",
    "NotNegative",
    "Positive",
    "PulseCount",
    "Real",
    "Share",
    "Table",
    "constant",
    "distribution",
    "plain",
]

Names = Annotated[tuple[str, ...], BeforeValidator(listed)]


class Table(BaseModel):
    """One table of a recipe: frozen, strict about types, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def to_dict(self) -> dict[str, Any]:
        """Fields as TOML has them, without those that are None: `Recipe.from_dict` makes an equal recipe of them."""
        return {name: plain(value) for name, value in self if value is not None}


class Distribution(Table):
    """One of `choices`, equally likely, or uniform between `low` and `high`."""

    choices: Annotated[tuple[Any, ...], BeforeValidator(listed)] = ()
    low: float | None = Field(None, ge=-1e19, le=1e19, description="lowest value")
    high: float | None = Field(None, ge=-1e19, le=1e19, description="highest value")
    log: bool = Field(False, description="whether uniform in the logarithm")

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if bool(self.choices) == (self.low is not None and self.high is not None):
            raise ValueError("needs a number, a list of choices, or low and high")
        if self.low is not None and self.high is not None:
            if not self.low <= self.high:
                raise ValueError(f"low = {self.low} is outside (-inf, {self.high}], {self.high} being high")
            if self.log and not self.low > 0:
                raise ValueError(f"low = {self.low} is outside (0, inf), the range of a logarithm")
            if not math.isfinite(self.high / self.low if self.log else self.high - self.low):
                raise ValueError(f"low = {self.low} and high = {self.high} are too far apart")
        if not all(map(_is_finite, self.choices)):
            raise ValueError(f"holds {shown(self.choices)}, not all of which are finite")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that can be drawn."""
        if self.choices:
            return min(self.choices), max(self.choices)
        assert self.low is not None and self.high is not None
        return self.low, self.high

    def draw(self, generator: np.random.Generator) -> Any:
        """One value."""
        if self.choices:
            return self.choices[int(generator.integers(len(self.choices)))]
        low, high = self.limits
        u = float(generator.random())
        return low * (high / low) ** u if self.log else low + (high - low) * u

    def to_dict(self) -> Any:
        """As TOML has it: a number, a list or a table."""
        if self.choices:
            single = len(self.choices) == 1 and not isinstance(self.choices[0], (list, tuple))
            return self.choices[0] if single else list(self.choices)
        return {"low": self.low, "high": self.high, **({"log": True} if self.log else {})}


def _is_finite(value: Any, depth: int = 0) -> bool:
    """Whether a choice, a number or a list of them, is free of NaN and infinity; words are."""
    if isinstance(value, list | tuple):
        return depth < 9 and all(_is_finite(one, depth + 1) for one in value)
    return not isinstance(value, float) or math.isfinite(value)


def distribution(value: Any) -> Any:
    """A number or a list as the table of a distribution."""
    if isinstance(value, (Mapping, Distribution)):
        return value
    return {"choices": list(value) if isinstance(value, (list, tuple)) else [value]}


def within(interval: str) -> AfterValidator:
    """A distribution of numbers in a range."""

    def check(value: Distribution) -> Distribution:
        values = value.choices or value.limits
        for one in values:
            try:
                check_real("value", one, interval)
            except ArgumentError:
                problem = f"is no number in {interval}"
                raise ValueError(problem if len(values) == 1 else f"holds {shown(one)}, which {problem}") from None
        return value

    return AfterValidator(check)


Positive = Annotated[Distribution, BeforeValidator(distribution), within("[1e-9, 1e9]")]
NotNegative = Annotated[Distribution, BeforeValidator(distribution), within("[0, 1e9]")]
PulseCount = Annotated[Distribution, BeforeValidator(distribution), within("[0.5, 9e18]")]
Share = Annotated[Distribution, BeforeValidator(distribution), within("[0, 1]")]
Angle = Annotated[Distribution, BeforeValidator(distribution), within("[-360, 360]")]
Real = Annotated[Distribution, BeforeValidator(distribution), within("[-1e9, 1e9]")]


def constant(value: float) -> Distribution:
    """The distribution of one value."""
    return Distribution(choices=(value,))


def plain(value: Any) -> Any:
    """A table, or what is in one, as TOML has it."""
    if isinstance(value, Table):
        return value.to_dict()
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    return list(value) if isinstance(value, tuple) else value
