"""Configurations (trees of frozen dataclasses) as text, as JSON, and back from JSON.

Reading follows the type hints of the expected classes, so that a file can choose settings but never run code. Classes
of the user are found if their modules are imported, see `own_modules`.
Configurations of older versions go through `migrations.migrate` first.
"""

from __future__ import annotations

import dataclasses
import difflib
import enum
import functools
import importlib
import json
import os
import pkgutil
import sys
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from tflane_jax.errors import UserError, printable
from tflane_jax.own_modules import VARIABLE, import_own

T = TypeVar("T")


def settings(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every setting by its dotted name; a nested configuration comes before its own settings."""
    for field in dataclasses.fields(config):
        name, value = prefix + field.name, getattr(config, field.name)
        yield name, value
        if dataclasses.is_dataclass(value):
            yield from settings(value, f"{name}.")


def to_text(config: Any) -> str:
    """Return one line `a.b.c = value` per setting; a nested configuration's own line names its class."""
    return "".join(f"{name} = {value_text(value)}\n" for name, value in settings(config))


def value_text(value: Any) -> str:
    """Return the value of a setting as text; of a nested configuration, its class."""
    return type(value).__name__ if dataclasses.is_dataclass(value) else repr(_plain(value))


def to_json(config: Any) -> dict[str, Any]:
    """Return plain JSON: the name of each configuration's class is its entry "class", enumerations are member names."""
    content = {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config)}
    return {"class": type(config).__name__, **content}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_json(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    return str(value) if isinstance(value, Path) else value


def from_json(kind: type[T], content: Any) -> T:
    """Return the configuration of class `kind` that `to_json` wrote.

    Settings that the file lacks take their defaults, so that runs of an older version can be read.

    Raises:
        UserError: names the setting that this version does not know or cannot read, or a module of TFLANE_IMPORT that
            cannot be imported.
    """
    import_own()
    return _dataclass(kind, content, "")


def subclasses(kind: type) -> dict[str, type]:
    """Return `kind` and the dataclasses derived from it, by class name.

    For an abstract base class (`HostConfig`, `HostLossConfig`), all modules of its package are imported first, so that
    every shipped subclass is found. Subclasses of other packages are found if they are imported already; of several
    with one name, the latest.

    Raises:
        UserError: an own class has the name of a shipped one, or of an own one in another file.
    """
    if _is_abstract(kind):
        _import_all(kind.__module__.rpartition(".")[0])
    found, waiting = {}, [kind]
    while waiting:
        each = waiting.pop(0)
        waiting += [c for c in each.__subclasses__() if c.__module__ in sys.modules]  # others: the import has failed
        earlier = found.get(each.__name__)
        if earlier is each:
            continue
        if earlier is not None and earlier.__module__.startswith("tflane_jax."):
            raise UserError(
                f"class {each.__name__} of {each.__module__} is called like one of tflane_jax: give it another name, "
                "because runs are read back by it"
            )
        if earlier is not None and (file := _file_of(each)) != (other := _file_of(earlier)):
            raise UserError(
                f"class {each.__name__} is defined in {other} and in {file}: give one another name, because runs are "
                "read back by it"
            )
        found[each.__name__] = each
    return found


def _file_of(kind: type) -> str:
    """Return the file that defines a class, or the module of a notebook or prompt."""
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    return kind.__module__ if file is None else os.path.realpath(file)


@functools.cache
def _import_all(name: str) -> None:
    """Import all modules of a package."""
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{name}.{module.name}")


def _is_open(kind: Any) -> TypeGuard[type]:
    """Return whether a setting of this type accepts subclasses."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind) and getattr(kind, "open_base", False)


def _is_abstract(kind: type) -> bool:
    """Return whether a class only stands for its subclasses."""
    return vars(kind).get("abstract_base", False)


def part_classes(kind: type) -> dict[str, type]:
    """Return the classes of all configurations that one of class `kind` can hold, at any depth, by name."""
    found: dict[str, type] = {}
    waiting: list[Any] = [kind]
    while waiting:
        hint = waiting.pop()
        waiting += typing.get_args(hint)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint) and hint.__name__ not in found:
            found[hint.__name__] = hint
            waiting += typing.get_type_hints(hint).values()
            waiting += subclasses(hint).values() if _is_open(hint) else ()
    return found


def added_settings(before: dict[str, Any], after: dict[str, Any], prefix: str = "") -> list[str]:
    """Return a line for each setting that only the second of two configurations (JSON) has, with its value there.

    A new part is one line, which names its class.
    """
    lines: list[str] = []
    for name, value in after.items():
        if name not in before:
            shown = value["class"] if isinstance(value, dict) else json.dumps(value)
            lines.append(f"setting {prefix}{name} is new: default {shown}")
        elif isinstance(value, dict) and isinstance(before[name], dict):
            lines += added_settings(before[name], value, f"{prefix}{name}.")
    return lines


def first_difference(there: dict[str, Any], here: dict[str, Any], prefix: str = "") -> str:
    """Return the first setting in which two configurations (JSON) differ, with both values; "" where none does."""
    for name in sorted(there.keys() | here.keys()):
        one, other = there.get(name), here.get(name)
        if one == other:
            continue
        if isinstance(one, dict) and isinstance(other, dict) and one.get("class") == other.get("class"):
            return first_difference(one, other, f"{prefix}{name}.")
        return f"{prefix}{name}: {_shown(one)} there, {_shown(other)} here"
    return ""


def _shown(value: Any) -> str:
    return printable(str(value.get("class", value) if isinstance(value, dict) else value))


def _dataclass(kind: Any, content: Any, path: str) -> Any:
    if isinstance(content, dict) and _is_open(kind):
        known, name = subclasses(kind), str(content.get("class", ""))
        if name not in known:
            _check_known(content, path.removesuffix("."))
        kind = known.get(name, kind)
    if not isinstance(content, dict) or content.get("class") != kind.__name__:
        name = path.removesuffix(".") or "at the top"
        raise UserError(f"setting {name} should be a {kind.__name__}, not {content!r:.80}")
    hints = typing.get_type_hints(kind)
    names = {field.name for field in dataclasses.fields(kind)}
    unknown = sorted(content.keys() - names - {"class"})
    if unknown:
        close = difflib.get_close_matches(unknown[0], names, 3)
        hint = f"; did you mean {' or '.join(path + name for name in close)}?" if close else ""
        raise UserError(f"setting {path}{printable(unknown[0])} is unknown to this version of tflane_jax{hint}")
    values = {name: _value(hints[name], content[name], path + name) for name in names & content.keys()}
    missing = [f.name for f in dataclasses.fields(kind) if f.name not in values and _is_required(f)]
    if missing:
        raise UserError(f"setting {path}{missing[0]} is missing")
    return kind(**values)


def _check_known(content: dict[str, Any], name: str) -> None:
    """Raise UserError for the content of a setting whose class no imported module has."""
    kind = content.get("class")
    if not isinstance(kind, str) or any(kind in vars(module) for module in list(sys.modules.values())):
        return
    raise UserError(
        f"class {printable(kind)} (setting {name}) is not part of this version of tflane_jax: if it is yours, import "
        f"its module (--import MODULE or {VARIABLE})"
    )


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _value(hint: Any, content: Any, path: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _member(arguments, content, path)
    if dataclasses.is_dataclass(hint):
        return _dataclass(hint, content, f"{path}.")
    if origin is tuple and isinstance(content, list):
        repeated = len(arguments) == 2 and arguments[1] is Ellipsis
        kinds = [arguments[0]] * len(content) if repeated else arguments
        if len(kinds) == len(content):
            return tuple(_value(k, item, path) for k, item in zip(kinds, content, strict=True))
    if origin is typing.Literal and content in arguments:
        return content
    if hint is Path and isinstance(content, str):
        return Path(content)
    if isinstance(hint, type) and issubclass(hint, enum.Enum) and isinstance(content, str):
        if content in hint.__members__:
            return hint[content]
        raise UserError(f"setting {path} cannot be {content!r:.80}")
    if hint is float and type(content) is int and abs(content) <= sys.float_info.max:
        return float(content)
    if isinstance(hint, type) and type(content) is hint:
        return content
    raise UserError(f"setting {path} cannot be {content!r:.80}")


def choices(config: Any, name: str) -> dict[str, Any]:
    """Return the classes of configurations that a setting can hold, by name.

    Where the setting may be absent, "None" is among them, and "default" for the first class. Empty for a setting that
    holds no configuration, or that `config` does not have.
    """
    owner, _, field = name.rpartition(".")
    for part in owner.split(".") if owner else ():
        config = getattr(config, part, None)
    hint = typing.get_type_hints(type(config)).get(field) if dataclasses.is_dataclass(config) else None
    kinds = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else ()
    named: dict[str, Any] = {}
    for kind in kinds or (hint,):
        if _is_open(kind):
            named |= {name: each for name, each in subclasses(kind).items() if not _is_abstract(each)}
        elif kinds and isinstance(kind, type) and dataclasses.is_dataclass(kind):
            named[kind.__name__] = kind
    if not kinds and len(named) == 1:
        return {}
    if named and type(None) in kinds:
        return {"None": type(None), "default": next(iter(named.values())), **named}
    return named


def with_setting(config: T, name: str, value: Any) -> T:
    """Return the configuration with one setting, named with dots, replaced; `limits.check_settings` checks values.

    Raises UserError for a name that is no setting.
    """
    first, _, rest = name.partition(".")
    names = [each.name for each in dataclasses.fields(config)] if dataclasses.is_dataclass(config) else []
    if first not in names:
        close = difflib.get_close_matches(first, names, 3)
        hint = f": did you mean {' or '.join(close)}?" if close else f", which has {', '.join(names) or 'none'}"
        raise UserError(f"{first} is no setting of {type(config).__name__}{hint}")
    changes: dict[str, Any] = {first: with_setting(getattr(config, first), rest, value) if rest else value}
    return dataclasses.replace(config, **changes)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _member(kinds: tuple[Any, ...], content: Any, path: str) -> Any:
    """Read the first member of a union that fits: None, the class with the saved name, or a plain type."""
    if content is None and type(None) in kinds:
        return None
    if isinstance(content, dict) and isinstance(content.get("class"), str):
        for kind in kinds:
            known = subclasses(kind) if _is_open(kind) else {getattr(kind, "__name__", ""): kind}
            if dataclasses.is_dataclass(kind) and content.get("class") in known:
                return _dataclass(kind, content, f"{path}.")
        if any(map(dataclasses.is_dataclass, kinds)):
            _check_known(content, path)
    for kind in kinds:
        if not dataclasses.is_dataclass(kind) and kind is not type(None):
            try:
                return _value(kind, content, path)
            except UserError:
                continue
    raise UserError(f"setting {path} cannot be {content!r:.80}")
