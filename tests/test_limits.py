"""Limits of settings: what fits a type, what the messages say, and in which order limits are looked at."""

import enum
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from tflane_jax.limits import (
    ASCENDING,
    DIFFERENT,
    INCREASING,
    NOT_EMPTY,
    Count,
    CountOrZero,
    Factor,
    Fraction,
    FractionBelowOne,
    Interval,
    Positive,
    PositiveOrInfinite,
    Range,
    Rules,
    Seed,
    SettingError,
    above,
    check_settings,
    splits,
)


class Colour(enum.Enum):
    RED = "crimson"


@dataclass(frozen=True)
class Inner:
    heads: Count = 4
    dim: Count = 8

    def limits(self) -> Rules:
        yield splits("heads", self.heads, "dim", self.dim)


@dataclass(frozen=True)
class Outer:
    any: Any = None
    text: str = ""
    flag: bool = False
    plain: float = 0.0
    path: Path | None = None
    colour: Colour = Colour.RED
    mode: Literal["a", 2] = "a"
    pair: tuple[float, int] = (0.5, 1)
    many: Annotated[tuple[Annotated[float, above(1)], ...], NOT_EMPTY, DIFFERENT] = (2.0,)
    steps: Annotated[tuple[int, ...], INCREASING] = ()
    low_high: Annotated[tuple[float, float], ASCENDING] = (1.0, 1.0)
    interval: Interval = (-1.0, 1.0)
    range: Range = (0.0, 0.0)
    count: Count = 1
    rest: CountOrZero = 0
    seed: Seed = 2**32 - 1
    lr: Positive = 1.0
    clip: PositiveOrInfinite | None = math.inf
    fraction: Fraction = 1.0
    decay: FractionBelowOne = 0.0
    factor: Factor = 1.0
    inner: Inner | None = Inner()
    parts: tuple[Inner, ...] = (Inner(),)

    def limits(self) -> Rules:
        yield "inner.dim", self.inner is None or self.inner.dim < 100 * self.count, "less than 100 counts"


def test_the_defaults_fit():
    check_settings(Outer())
    check_settings(Outer(any=object(), plain=3, path=Path("x"), mode=2, clip=None, inner=None, parts=()))


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("text", 3, "text"),
        ("text", None, "text"),
        ("flag", 1, "True or False"),
        ("plain", math.nan, "a finite number"),
        ("plain", -math.inf, "a finite number"),
        ("plain", True, "a finite number"),
        ("path", "x", r"a path \(pathlib.Path\) or None"),
        ("colour", "RED", "RED"),
        ("mode", "b", "'a' or 2"),
        ("mode", True, "'a' or 2"),
        ("pair", (0.5, 1.5), r"\(a finite number, a whole number\)"),
        ("pair", (0.5,), r"\(a finite number, a whole number\)"),
        ("pair", [0.5, 1], r"\(a finite number, a whole number\)"),
        ("many", (), "at least one of them"),
        ("many", (2.0, 1.0), "a tuple, each item a finite number above 1"),
        ("many", (2.0, 2.0), "all different"),
        ("many", (math.inf,), "a finite number above 1"),
        ("steps", (1, 1), "each above the one before"),
        ("low_high", (2.0, 1.0), "in ascending order"),
        ("interval", (1.0, 1.0), "each above the one before"),
        ("range", (-1.0, 1.0), "a finite number of at least 0"),
        ("count", 0, "a whole number of at least 1"),
        ("count", 1.0, "a whole number of at least 1"),
        ("count", 2**31, "at most 2147483647"),
        pytest.param("count", 10**5000, "a whole number of at least 1", id="digits"),
        ("seed", 2**32, "a whole number of at least 0 and at most 4294967295"),
        ("plain", 10**400, "a finite number"),
        ("rest", -1, "a whole number of at least 0"),
        ("lr", 0.0, "a finite number above 0"),
        ("lr", math.inf, "a finite number above 0"),
        ("clip", 10**400, "a number above 0, or inf or None"),
        ("clip", -1.0, "a number above 0, or inf or None"),
        ("clip", math.nan, "a number above 0, or inf or None"),
        ("fraction", 1.5, "a finite number from 0 to 1"),
        ("decay", 1.0, "of at least 0 and below 1"),
        ("factor", 0.0, "above 0 and at most 1"),
        ("inner", Colour.RED, "Inner or None"),
        ("inner", Inner, "Inner or None"),
    ],
)
def test_what_does_not_fit_is_named_with_what_does(name, value, allowed):
    with pytest.raises(SettingError, match=rf"^a\.b\.{name} is .*: it must be .*{allowed}") as error:
        check_settings(replace(Outer(), **{name: value}), "a.b.")
    assert error.value.setting == f"a.b.{name}"
    assert error.value.value is value


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (Outer(inner=Inner(heads=3)), r"^inner\.heads is 3: it must be a divisor of dim \(8\)$"),
        (
            Outer(inner=Inner(heads=0)),
            r"^inner\.heads is 0: it must be a whole number of at least 1 and at most 2147483647$",
        ),
        (Outer(parts=(Inner(), Inner(dim=-4))), r"^parts\[1\]\.dim is -4"),
        (Outer(parts=(Inner(), Inner(heads=5))), r"^parts\[1\]\.heads is 5: it must be a divisor"),
        (Outer(inner=Inner(dim=800)), r"^inner\.dim is 800: it must be less than 100 counts$"),
        # Single settings come before rules over several, inner rules before outer ones.
        (Outer(inner=Inner(heads=3, dim=800), count=0), "^count is 0"),
        (Outer(inner=Inner(heads=3, dim=800)), r"^inner\.heads is 3"),
    ],
)
def test_the_first_broken_limit_is_named(config, message):
    with pytest.raises(SettingError, match=message):
        check_settings(config)


def test_long_values_are_shortened():
    with pytest.raises(SettingError) as error:
        check_settings(Outer(many=tuple([0.5] * 1000)))
    assert len(str(error.value)) < 300
    assert "..." in str(error.value)
