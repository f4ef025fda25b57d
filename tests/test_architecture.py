"""The structure that docs/architecture.md describes: floors, sizes of files, slow imports, citations, wide lines."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tests.shared import ROOT

# From the ground up. A file imports from its own package and from the lines above its own, never from its own line.
FLOORS = (
    "errors recent",
    "limits accelerators memory own_modules",
    "cores",
    "config_io config_files migrations processes progress child_processes",
    "startup",
    "devices",
    "geometry",
    "files",
    "scene",
    "world.roads",
    "world.render",
    "world.bev",
    "world.traffic",
    "world.cameras world.front_view",
    "world.moving world.excerpt",
    "world.terrain world.mirror world.view",
    "world.warp",
    "world.simulate",
    "world.presets",
    "markers",
    "priors",
    "layers",
    "models",
    "matching",
    "losses",
    "metrics",
    "scoring",
    "datasets",
    "evaluation",
    "plots",
    "training",
    "tasks",
    "convert",
    "config",
    "config_overrides config_help",
    "run_checks training_nearness",
    "runs",
    "summary export",
    "plan",
    "ablations",
    "demo",
    "commands",
    "cli",
    "__main__",
)
# What learns and measures, and what reads data, know nothing of each other; `evaluation` joins them.
LEARNING = {"priors", "layers", "models", "matching", "losses", "metrics", "scoring"}
FLOOR = {room: height for height, rooms in enumerate(FLOORS) for room in rooms.split()}

LONGEST_FILE = 350

# About a second each: imported in functions, by the commands that need them.
SLOW_MODULES = {"orbax", "matplotlib", "grain", "cv2", "pyarrow", "shapely", "tyro", "tensorboardX"}

# Files that name the reference data outside the repository, to find it.
FINDING_SHARED_DATA = {"tests/shared.py", "tests/golden.py", "tests/same_losses.py", "tests/test_architecture.py"}

WIDEST_LINE = 120


@cache
def python_files() -> dict[str, str]:
    """Return path -> text of every Python file of the repository."""
    folders = ("tflane_jax", "configs", "benchmarks", "tests")
    paths = [*ROOT.glob("*.py"), *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(paths)}


def pages() -> dict[str, str]:
    """Return path -> text of every Markdown page."""
    paths = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(paths)}


def imported_modules(tree: ast.AST) -> set[str]:
    """Return the dotted names that imports name, wherever they stand; `from a import b` gives `a.b`."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def room_of(module: str) -> str | None:
    """Return the package, module or wing of the world that holds a module of ours; None for all else."""
    parts = module.split(".")
    if parts[0] != "tflane_jax" or len(parts) < 2 or parts[1] == "__version__":
        return None
    return ".".join(parts[1:3]) if parts[1] == "world" and len(parts) > 2 else parts[1]


@cache
def room_imports() -> dict[tuple[str, str], list[str]]:
    """Return (from, to) -> files with an import from one room into another."""
    found: dict[tuple[str, str], list[str]] = {}
    for path, text in python_files().items():
        source = room_of(path.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
        if source is None:
            continue
        for target in {room_of(module) for module in imported_modules(ast.parse(text))} - {source, None}:
            found.setdefault((source, str(target)), []).append(path)
    return found


def test_every_package_has_its_floor():
    rooms = {room for pair in room_imports() for room in pair}
    assert rooms <= FLOOR.keys(), "add the new package to FLOORS, at the height that its imports allow"


def test_imports_go_downward_only():
    wrong = {pair: paths for pair, paths in room_imports().items() if FLOOR[pair[1]] >= FLOOR[pair[0]]}
    assert wrong == {}


def test_datasets_and_the_learning_core_do_not_import_each_other():
    pairs = room_imports()
    assert {source for source, target in pairs if target == "datasets"} & LEARNING == set()
    assert {target for source, target in pairs if source == "datasets"} & LEARNING == set()


def test_upward_imports_would_be_found():
    tree = ast.parse("def f():\n    from tflane_jax.models.host import Host\n    import tflane_jax.world.roads.lines\n")
    assert {room_of(module) for module in imported_modules(tree)} == {"models", "world.roads"}


def test_no_python_file_is_too_long():
    long = {path: text.count("\n") for path, text in python_files().items() if text.count("\n") > LONGEST_FILE}
    assert long == {}


def test_only_layers_and_models_use_linen():
    users = {
        path
        for path, text in python_files().items()
        if path.startswith("tflane_jax/")
        and any(f"{module}.".startswith("flax.linen.") for module in imported_modules(ast.parse(text)))
    }
    assert users, "nothing found: has the import changed?"
    assert {path for path in users if not path.startswith(("tflane_jax/layers/", "tflane_jax/models/"))} == set()


def test_slow_modules_are_imported_in_functions():
    at_import = {
        path: slow
        for path, text in python_files().items()
        if path.startswith("tflane_jax/")
        and (slow := SLOW_MODULES & {module.split(".")[0] for module in imports_at_module_level(ast.parse(text))})
    }
    assert at_import == {}


def imports_at_module_level(tree: ast.Module) -> set[str]:
    """Return the imports that run when the module is imported: not those in functions or for type checkers only."""
    statements: list[ast.AST] = list(tree.body)
    found = set()
    while statements:
        node = statements.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            found |= imported_modules(node)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inner = ast.iter_child_nodes(node)
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                inner = node.orelse
            statements += [child for child in inner if isinstance(child, ast.stmt | ast.ExceptHandler)]
    return found


def test_imports_at_module_level_are_told_from_lazy_ones():
    checked = "import a\nif TYPE_CHECKING:\n    import b\nelse:\n    import c\n"
    guarded = "try:\n    import d.e\nexcept ImportError:\n    import f\nclass C:\n    import g\n"
    lazy = "def h():\n    import i\n"
    assert imports_at_module_level(ast.parse(checked + guarded + lazy)) == {"a", "c", "d.e", "f", "g"}


def test_no_file_cites_files_outside_the_repository():
    others = [ROOT / "Makefile", ROOT / "pyproject.toml", *(ROOT / "notebooks").glob("*.ipynb")]
    texts = python_files() | pages() | {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in others}
    citing = {path: found for path, text in texts.items() if (found := citations(text))}
    assert "tests/test_architecture.py" in citing, "nothing found: has the pattern changed?"
    assert {path: found for path, found in citing.items() if path not in FINDING_SHARED_DATA} == {}


def citations(text: str) -> list[str]:
    """Return the mentions of the folders with reference data and specifications beside the repository."""
    return re.findall(r"\bspecs/\w+|(?<![\w/])shared/(?:data|golden|papers|specs)\b|\.\./shared", text)


def test_citations_are_told_from_other_words():
    assert citations("see specs/modules.md, ../shared, shared/data/x") == ["specs/modules", "../shared", "shared/data"]
    assert citations("tests.shared, shared/linear, TFLANE_SHARED, specification") == []


@pytest.mark.parametrize("path", pages())
def test_lines_of_pages_fit_the_screen(path):
    text = re.sub(r"^```.*?^```", "", pages()[path], flags=re.DOTALL | re.MULTILINE)
    lines = [line for line in pages()[path].splitlines() if len(line) > WIDEST_LINE]
    assert [line for line in lines if not _may_be_wide(line)] == [], f"longer than {WIDEST_LINE} characters"
    assert text.count("```") == 0, "a code block is not closed"


def _may_be_wide(line: str) -> bool:
    """Return whether a line is a table row, or a link or picture alone, which cannot be broken."""
    return line.startswith("|") or re.fullmatch(r"!?\[.*\]\(.*\)\S?", line) is not None


def test_links_between_pages_lead_somewhere():
    for path, text in pages().items():
        for target in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", text):
            assert Path(ROOT / path).parent.joinpath(target).exists(), f"{path} links to {target}, which does not exist"
