"""Limits of settings: written where a setting is defined, enforced by one walk over a whole configuration.

    @dataclass(frozen=True)
    class OptimConfig:
        lr: Positive = 2e-4                       # a limit of one setting is part of its type
        warmup_steps: CountOrZero = 500
        drops: DropsConfig | None = None

        def limits(self) -> Rules:                # limits that concern several settings
            yield "drops", self.drops is None or not self.epoch_steps, "None where epoch_steps is set"

Types count as limits, and numbers must be finite unless their limit allows more. The types here are those that many
settings share; others are written as `Annotated[float, above(1)]`.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import itertools
import sys
import types
import typing
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from tflane_jax.errors import UserError


class SettingError(UserError):
    """A setting that breaks a limit.

    Attributes:
        setting: its dotted name.
        value: its value.
        shown: the value in one short line.
        allowed: the allowed values, in words.
    """

    def __init__(self, setting: str, value: Any, allowed: str):
        self.setting, self.value, self.shown, self.allowed = setting, value, _shown(value), allowed
        super().__init__(f"{setting} is {self.shown}: it must be {allowed}")


Rules = Iterator[tuple[str, bool, str]]
"""What `limits()` yields: a setting (dotted where it belongs to a part), whether it is allowed, and what is allowed."""


@dataclasses.dataclass(frozen=True)
class Limit:
    """A limit of one value.

    Attributes:
        allowed: completes "it must be a finite number ...".
        holds: value -> whether it is allowed.
        finite: whether numbers must be finite.
    """

    allowed: str
    holds: Callable[[Any], bool]
    finite: bool = True


def above(least: float) -> Limit:
    """Return the limit of numbers above `least`."""
    return Limit(f"above {least:g}", lambda value: value > least)


def at_least(least: float) -> Limit:
    """Return the limit of numbers from `least` on."""
    return Limit(f"of at least {least:g}", lambda value: value >= least)


def counted(least: int, most: int = 2**31 - 1) -> Limit:
    """Return the limit of whole numbers from `least` to `most`, by default the largest that arrays are indexed with."""
    return Limit(f"of at least {least} and at most {most}", lambda value: least <= value <= most)


def below(end: float) -> Limit:
    """Return the limit of numbers below `end`."""
    return Limit(f"below {end:g}", lambda value: value < end)


def within(low: float, high: float) -> Limit:
    """Return the limit of numbers from `low` to `high`."""
    return Limit(f"from {low:g} to {high:g}", lambda value: low <= value <= high)


def at_least_below(least: float, end: float) -> Limit:
    """Return the limit of numbers from `least` on and below `end`."""
    return Limit(f"of at least {least:g} and below {end:g}", lambda value: least <= value < end)


def above_at_most(least: float, most: float) -> Limit:
    """Return the limit of numbers above `least` and at most `most`."""
    return Limit(f"above {least:g} and at most {most:g}", lambda value: least < value <= most)


ASCENDING = Limit("in ascending order", lambda pair: list(pair) == sorted(pair))
INCREASING = Limit("each above the one before", lambda items: all(a < b for a, b in itertools.pairwise(items)))
DIFFERENT = Limit("all different", lambda items: len(set(items)) == len(items))
NOT_EMPTY = Limit("at least one of them", lambda items: len(items) > 0)
SOME_SHARE = Limit("not all 0", lambda items: sum(items) > 0)
SOME_WEIGHT = Limit("with a weight above 0", lambda pairs: sum(weight for _, weight in pairs) > 0)

Count = Annotated[int, counted(1)]
CountOrZero = Annotated[int, counted(0)]
LARGEST_SEED = 2**32 - 1
"""JAX takes 32 bits of a seed: a larger one would be another one again."""
Seed = Annotated[int, counted(0, LARGEST_SEED)]
Positive = Annotated[float, above(0)]
PositiveOrZero = Annotated[float, at_least(0)]
# The least that a loss divides by: in float32 its fourth power is not rounded to 0.
Divisor = Annotated[float, at_least(1e-9)]
PositiveOrInfinite = Annotated[float, Limit("above 0, or inf", lambda value: value > 0, finite=False)]
Fraction = Annotated[float, within(0, 1)]
"""A fraction or a probability."""
FractionBelowOne = Annotated[float, at_least_below(0, 1)]
"""Dropout, momentum, decay of an average: at 1, nothing would pass."""
Factor = Annotated[float, above_at_most(0, 1)]
"""A factor that keeps or reduces."""
Interval = Annotated[tuple[float, float], INCREASING]
"""(low, high) with something between."""
Range = Annotated[tuple[PositiveOrZero, PositiveOrZero], ASCENDING]
"""(low, high) of a quantity that is not negative, from which a value is drawn; both may be equal."""

PositiveRange = Annotated[tuple[Positive, Positive], ASCENDING]
"""(low, high) of a quantity that is never 0."""
Shares = Annotated[tuple[PositiveOrZero, PositiveOrZero, PositiveOrZero, PositiveOrZero], SOME_SHARE]
"""Relative frequencies of four kinds."""


def splits(setting: str, parts: int, name: str, whole: int) -> tuple[str, bool, str]:
    """Return the rule that `parts`, the value of a setting, divides `whole`, which is called `name`."""
    return setting, whole % parts == 0, f"a divisor of {name} ({whole})"


def check_settings(config: Any, prefix: str = "") -> None:
    """Raise SettingError for the first setting of a configuration that breaks a limit.

    Args:
        config: frozen dataclass, with others inside.
        prefix: name of the configuration itself with a dot behind, "" for a whole run.
    """
    parts = list(_parts(config, prefix))
    for name, part in parts:
        for setting, hint, fits in _checks(type(part)):
            if not fits(value := getattr(part, setting)):
                raise SettingError(name + setting, value, _described(hint))
    # Rules over several settings may divide by them and compare them, so each by itself comes first. Those of a part
    # come before those of the whole.
    for name, part in reversed(parts):
        for setting, allowed, wanted in getattr(part, "limits", tuple)():
            if not allowed:
                raise SettingError(name + setting, attrgetter(setting)(part), wanted)


def _parts(config: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield all configurations with the prefixes of their settings, outer ones before inner ones."""
    yield prefix, config
    for field in dataclasses.fields(config):
        for path, part in _dataclasses(field.name, getattr(config, field.name)):
            yield from _parts(part, f"{prefix}{path}.")


def _dataclasses(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a configuration by its name, or those of a tuple by name and position."""
    if isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _dataclasses(f"{name}[{index}]", item)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield name, value


def allowed_for(config: Any, setting: str) -> str:
    """Return in words what a setting of a configuration, by its dotted name, may be."""
    part, _, name = setting.rpartition(".")
    kind = type(attrgetter(part)(config) if part else config)
    return _described(next(hint for field, hint, _ in _checks(kind) if field == name))


def forget_types() -> None:
    """Look at the types of settings again, because a union of classes has got another member."""
    _checks.cache_clear()


@functools.cache
def _checks(kind: type) -> list[tuple[str, Any, Callable[[Any], bool]]]:
    """Return name and type of the settings of a class, and what tells whether a value is of the type."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return [(field.name, hints[field.name], _check(hints[field.name])) for field in dataclasses.fields(kind)]


def _check(hint: Any, *, finite: bool = True) -> Callable[[Any], bool]:
    """Return what tells whether a value is of a type and within its limits.

    Types are taken apart here, once for a class: doing it again for each value took most of a configuration's loading.

    Args:
        hint: the type.
        finite: forbids infinite and undefined numbers.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        limits = [extra for extra in arguments[1:] if isinstance(extra, Limit)]
        kind = _check(arguments[0], finite=finite and all(limit.finite for limit in limits))
        return lambda value: kind(value) and all(limit.holds(value) for limit in limits)
    if origin in (typing.Union, types.UnionType):
        members = [_check(member) for member in arguments]
        return lambda value: any(fits(value) for fits in members)
    if origin is typing.Literal:
        return lambda value: any(value == member and type(value) is type(member) for member in arguments)
    if origin is tuple:
        return _check_tuple(arguments, finite=finite)
    if hint is float:
        return _is_finite if finite else _is_real
    if hint is int:
        return lambda value: isinstance(value, int) and not isinstance(value, bool)
    if hint is Any or not isinstance(hint, type) or getattr(hint, "_is_protocol", False):
        return lambda value: True
    return lambda value: isinstance(value, hint)


def _check_tuple(arguments: tuple[Any, ...], *, finite: bool) -> Callable[[Any], bool]:
    if arguments[1:] == (Ellipsis,):
        item_fits = _check(arguments[0], finite=finite)
        return lambda value: isinstance(value, tuple) and all(item_fits(item) for item in value)
    members = [_check(member, finite=finite) for member in arguments]

    def fits(value: Any) -> bool:
        if not isinstance(value, tuple) or len(value) != len(members):
            return False
        return all(item_fits(item) for item_fits, item in zip(members, value, strict=True))

    return fits


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_real(value: Any) -> bool:
    return _is_finite(value) or isinstance(value, float)


_WORDS = {float: "a finite number", int: "a whole number", str: "text", bool: "True or False", type(None): "None"}


def _described(hint: Any) -> str:
    """Return in words what a type and its limits allow."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        limits = [extra for extra in arguments[1:] if isinstance(extra, Limit)]
        kind = _described(arguments[0])
        kind = kind if all(limit.finite for limit in limits) else kind.replace("a finite number", "a number")
        separator = ", " if typing.get_origin(arguments[0]) is tuple else " "
        return separator.join([kind, *(limit.allowed for limit in limits)])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_described(member) for member in arguments)
    if origin is typing.Literal:
        return " or ".join(repr(member) for member in arguments)
    if origin is tuple:
        if arguments[1:] == (Ellipsis,):
            return f"a tuple, each item {_described(arguments[0])}"
        return f"({', '.join(_described(member) for member in arguments)})"
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return " or ".join(hint.__members__)
    if isinstance(hint, type) and issubclass(hint, Path):
        return "a path (pathlib.Path)"
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))


def _shown(value: Any) -> str:
    """Return a value in one short line."""
    if dataclasses.is_dataclass(value):
        return type(value).__name__ if not isinstance(value, type) else f"the class {value.__name__}"
    try:
        text = value.name if isinstance(value, enum.Enum) else " ".join(repr(value).split())
    except ValueError as error:  # an integer of more than 4300 digits
        return f"a value that cannot be shown ({str(error).partition(';')[0]})"
    return text if len(text) <= 100 else f"{text[:97]}..."
