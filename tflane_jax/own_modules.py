"""Python of the user: modules with own classes, and configuration files.

A class defined there is found by its name like one of the package, also in processes that this one starts: modules are
found by `sys.path`, which they inherit, and files by TFLANE_FILES.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import shlex
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from tflane_jax.errors import UserError

VARIABLE = "TFLANE_IMPORT"
"""Environment variable: modules to import, separated by commas."""
_FILES = "TFLANE_FILES"
"""Environment variable for processes that this one starts: files that it has imported, one a line."""
_PREFIX = "tflane_file_"
# Folders that were added to those in which modules are found because a file there was imported.
_beside: set[str] = set()


def take_imports(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the modules that `--import MODULE` names, which may stand anywhere, and the other arguments."""
    modules: list[str] = []
    others: list[str] = []
    left = list(arguments)
    while left:
        first = left.pop(0)
        if first == "--":
            others += [first, *left]
            break
        if first.startswith("--import="):
            modules.append(first.removeprefix("--import="))
        elif first == "--import" and left:
            modules.append(left.pop(0))
        else:
            others.append(first)
    return modules, others


def add_imports(modules: Sequence[str]) -> None:
    """Add modules to those that `import_own` imports, in this process and in those that it starts."""
    if modules:
        os.environ[VARIABLE] = ",".join(dict.fromkeys([*_named(), *modules]))


def import_own() -> None:
    """Import the modules that TFLANE_IMPORT names: importable ones, or files (`folder/own.py`).

    They are looked for like those of `python -m`, also in the working directory.

    Raises:
        UserError: one of them cannot be imported.
    """
    for name in _named():
        _find_in_working_directory()
        try:
            if name.endswith(".py"):
                import_file(Path(name))
            else:
                importlib.import_module(name)
        except (Exception, SystemExit) as error:
            raise UserError(
                f"module {name} (--import or {VARIABLE}) cannot be imported: {type(error).__name__}: {error}"
            ) from error


def _find_in(folder: str) -> None:
    """Let modules of a folder be imported; installed ones of the same name win."""
    if folder not in sys.path:
        sys.path.append(folder)


def _find_in_working_directory() -> None:
    with contextlib.suppress(FileNotFoundError):  # it may be gone
        if "" not in sys.path:  # which stands for it
            _find_in(os.getcwd())


def import_file(path: Path, *, beside: bool = True) -> ModuleType:
    """Return the module of a Python file, which runs once as long as its content stays the same.

    Its name comes from path and content. With `beside`, modules in its folder and in the working directory can be
    imported from then on.
    """
    path = path.resolve()
    known = _files()
    if str(path) not in known:
        os.environ[_FILES] = "\n".join([*known, str(path)])
    if beside:
        _find_in_working_directory()
        _find_in(str(path.parent))
        _beside.add(str(path.parent))
    return importlib.import_module(_module_name(path))


def imports_of(config: Any) -> str:
    """Return the options, " --import MODULE ...", that a command needs to read a configuration; "" for none.

    Args:
        config: a dataclass, whose settings may be dataclasses of the user.
    """
    found = dict.fromkeys(_importable(kind.__module__) for kind in _classes(config) if is_own(kind))
    return "".join(f" --import {shlex.quote(name)}" for name in found)


def _importable(module: str) -> str:
    """Return by what another command finds a module: its name, or its file if only a file beside it was looked for."""
    file = sys.modules[module].__file__
    if file is None:
        return module
    beside = os.path.dirname(file) in _beside and not os.path.samefile(os.path.dirname(file), os.getcwd())
    return os.path.relpath(file) if beside or module.startswith(_PREFIX) else module


def own_content(config: Any) -> str:
    """Return a hash of the code of a configuration's own modules, and of the paths of those imported as files.

    They define its own classes, or are the user's and imported by such modules (`_own_modules`). "" for none.
    """
    modules = sorted(_own_modules(config))
    return hashlib.sha256("".join(map(_content, modules)).encode()).hexdigest() if modules else ""


def own_code(config: Any) -> str:
    """Return a hash of the code of a configuration's own modules alone, wherever their files lie; "" for none."""
    hashes = sorted(filter(None, map(_code_of, _own_modules(config))))
    return hashlib.sha256("".join(hashes).encode()).hexdigest() if hashes else ""


@functools.cache
def _code_of(module: str) -> str:
    """Return the hash of a module's file as it was when first asked for: code edited later is not what runs."""
    file = getattr(sys.modules[module], "__file__", None)
    return "" if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()


@functools.cache
def _content(module: str) -> str:
    """Return a text that changes with a module: of a file, its name, made from path and content; else `_code_of`."""
    if module.startswith(_PREFIX):
        return module
    return _code_of(module)


def _own_modules(config: Any) -> set[str]:
    """Return the modules that define a configuration's own classes, and all of the user's that they import at once.

    What a function imports when it is called is left out, because it is known only then.
    """
    left = [kind.__module__ for kind in _classes(config) if is_own(kind)]
    found: set[str] = set()
    while left:
        if (name := left.pop()) not in found:
            found.add(name)
            left += filter(_is_users, _imports(name))
    return found


@functools.cache
def _imports(module: str) -> tuple[str, ...]:
    """Return the names that the import statements of a module may mean as modules; of functions in it, none."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None:
        return ()
    try:
        tree = ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):  # edited since, or no source
        return ()
    found: set[str] = set()
    left: list[ast.AST] = list(tree.body)
    package = sys.modules[module].__package__ or ""
    while left:
        node = left.pop()
        if isinstance(node, ast.Import):
            found |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            found |= {base, *(f"{base}.{one.name}" for one in node.names)}
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not _for_types(node):
            left += ast.iter_child_nodes(node)
    return tuple(sorted({outer for name in found for outer in _with_packages(name)}))


def _with_packages(name: str) -> list[str]:
    """Return a module's name and those of the packages around it, which its import also runs: a, a.b and a.b.c."""
    parts = name.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts) + 1)]


def _for_types(node: ast.AST) -> bool:
    """Return whether a statement is `if TYPE_CHECKING:`, whose imports happen only where somebody else makes them."""
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


@functools.cache
def _is_users(module: str) -> bool:
    """Return whether a module is a file of the user: no part of this package, not Python's, and not installed."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None or module.partition(".")[0] == __name__.partition(".")[0]:
        return False
    installed = {"site-packages", "dist-packages"} & set(Path(file).parts)
    return not installed and not Path(file).is_relative_to(sysconfig.get_path("stdlib"))


def is_own(kind: type) -> bool:
    """Return whether a class is the user's, and none of the package."""
    return kind.__module__.partition(".")[0] != __name__.partition(".")[0]


def _classes(config: Any) -> Iterator[type]:
    if dataclasses.is_dataclass(config):
        yield type(config)
        for field in dataclasses.fields(config):
            yield from _classes(getattr(config, field.name))
    elif isinstance(config, tuple):
        for one in config:
            yield from _classes(one)


def _named() -> list[str]:
    return [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]


def _files() -> list[str]:
    return os.environ.get(_FILES, "").splitlines()


def _module_name(path: Path) -> str:
    digest = hashlib.sha256(f"{path}\n".encode() + path.read_bytes()).hexdigest()[:16]
    return f"{_PREFIX}{''.join(c if c.isalnum() else '_' for c in path.stem)}_{digest}"


class _Loader(importlib.machinery.SourceFileLoader):
    """Always compiles the source.

    Python takes cached byte code if the source's time (in whole seconds) and size match: it would miss a quick edit.
    """

    def get_code(self, fullname: str) -> Any:
        return self.source_to_code(self.get_data(self.path), self.path)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the modules of `import_file`, also for what another process has pickled."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if not fullname.startswith(_PREFIX):
            return None
        for file in map(Path, _files()):
            if file.is_file() and _module_name(file) == fullname:
                return importlib.util.spec_from_file_location(fullname, file, loader=_Loader(fullname, str(file)))
        return None


sys.meta_path.append(_Finder())
