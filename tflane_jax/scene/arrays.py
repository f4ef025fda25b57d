"""The array type of the containers, numpy on the host and JAX on the device, and the check of shapes and types."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

# A union would make pyright reject operations that only one of the two types allows.
if TYPE_CHECKING:
    Array = Any
else:
    Array = np.ndarray | jax.Array


def check_shapes(container: Any) -> None:
    """Check the fields of a container against shapes and types in their annotations, and validate containers in it.

    A letter stands for one length in all fields of a container. A field that may be None is checked if it is not.
    Raises AssertionError naming the first field that does not fit those before it, or is of another type: a mask of
    integers would index, and evidence of floats is not divided by 255.
    """
    lengths: dict[str, int] = {}
    for name, (axes, types, optional) in _fields(type(container)).items():
        value = getattr(container, name)
        if value is None and optional:
            continue
        if value is None:
            raise AssertionError(f"{name} is None")
        if axes is None:
            try:
                value.validate()
            except AssertionError as error:
                raise AssertionError(f"{name}.{error}") from None
            continue
        found = np.shape(value)
        fits = len(found) == len(axes) and all(
            length == (int(axis) if axis.isdigit() else lengths.setdefault(axis, length))
            for axis, length in zip(axes, found, strict=True)
        )
        if not fits:
            wanted = ", ".join(str(lengths.get(axis, axis)) for axis in axes) + "," * (len(axes) == 1)
            raise AssertionError(f"{name} is of shape {found}, expected ({wanted})")
        own = str(value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype)
        if own not in types and not (_word(types) == "int" and own.startswith("uint")):
            raise AssertionError(f"{name} is {own}, expected {_word(types)}")


def _word(types: Sequence[str]) -> str:
    """Return one name for the types of an annotation: "float" for floats of all lengths."""
    return types[0] if len(types) == 1 else next(kind for kind in ("bool", "float", "int") if kind in " ".join(types))


@functools.cache
def _fields(kind: type) -> dict[str, tuple[list[str] | None, tuple[str, ...], bool]]:
    """Return for each field its axes, None for a container, the names of its types, and whether it may be None."""
    hints, fields = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        members = typing.get_args(hints[field.name]) or (hints[field.name],)
        arrays = [member for member in members if hasattr(member, "dim_str")]
        axes, types = (arrays[0].dim_str.split(), tuple(map(str, arrays[0].dtypes))) if arrays else (None, ())
        fields[field.name] = axes, types, type(None) in members
    return fields
