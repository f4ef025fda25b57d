"""Notebooks run from top to bottom and draw, their outputs are stored; the example of the README runs."""

import ast
import functools
import inspect
import re

import jax
import pytest

from tests.shared import ROOT
from tests.slow import with_slow

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MOST_BYTES = 600_000

RANDOM_WEIGHTS = """
from tests.parameters import random_params
from tflane_jax.runs import save_weights

folder, scenes = Path({folder!r}), 2
settings = "--task.model.decoder.layers 1 --task.model.encoder.levels 32"


def train_run(config, folder, start):
    assert start == "new"
    example = config.task.shapes(config.data)
    if config.task.frames > 1:  # only the shapes count, and those of a clip have one axis more
        example = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), example)
    save_weights(config, random_params(config.task.init, example), folder)
"""
# Each follows the cell of parameters. Models that are too small to be any good: random weights, or two updates.
SMALL = {
    "traffic_flow": RANDOM_WEIGHTS,
    "markers": RANDOM_WEIGHTS,
    "masking": """
folder, scenes, rounds = Path({folder!r}), 2, 2
settings = "--training.steps 2 --training.log-every 1 --training.eval-every 2 --optim.warmup-steps 1"
settings += " --evaluation.pictures 0 --data.train 2 --data.val 1"
settings += " --task.model.decoder.layers 1 --task.model.encoder.levels 32"
runs = {{"joint": "tf_lane/masking:joint"}}
""",
    "lane_shapes": RANDOM_WEIGHTS
    + """
settings, images = "--data.train 4", 6
""",
}
PICTURES = {"traffic_flow": 6, "masking": 4, "markers": 4, "lane_shapes": 5}
# What a small run says of its data.
READ = {
    "traffic_flow": "8 validation frames of 2 scenes",
    "masking": "8 validation frames of 2 scenes",
    "markers": "16 validation frames of 2 scenes",
    "lane_shapes": "6 validation images",
}


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    nbformat = pytest.importorskip("nbformat")
    return request.param.stem, nbformat.read(request.param, as_version=4)


@pytest.mark.parametrize(
    "notebook",
    [pytest.param(path, marks=[pytest.mark.slow] * (path.stem != "masking"), id=path.stem) for path in NOTEBOOKS],
    indirect=True,
)
@pytest.mark.filterwarnings("default")
def test_notebook_runs(notebook, tmp_path, monkeypatch):
    (name, notebook), client = notebook, pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    (place,) = [i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", [])]
    small = SMALL[name].format(folder=str(tmp_path / "runs"))
    notebook.cells.insert(place + 1, nbformat.v4.new_code_cell(small))
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    assert pictures(notebook) >= PICTURES[name]
    assert READ[name] in printed(notebook)


def test_functions_that_notebooks_call_exist_and_take_their_arguments(notebook):
    """A name that has gone is found without running a notebook."""
    nodes = list(ast.walk(ast.parse("\n".join(c.source for c in notebook[1].cells if c.cell_type == "code"))))
    imported: dict = {}
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            exec(ast.unparse(node), imported)
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    known = [call for call in calls if names(call.func) <= imported.keys()]
    assert len(known) > 20
    for call in known:
        function = eval(ast.unparse(call.func), imported)
        if inspect.isfunction(function):
            inspect.signature(function).bind_partial(**{each.arg: None for each in call.keywords if each.arg})


def test_trainings_of_notebooks_go_on_after_a_stop_and_refuse_other_settings(notebook, tmp_path):
    """A run that is taken because its folder exists may be a part of one, or one with other settings."""
    started = []
    for cell in notebook[1].cells:
        for node in ast.walk(ast.parse(cell.source if cell.cell_type == "code" else "")):
            if isinstance(node, ast.For) and "train_run" in names(node):
                runs = {name: name for name in ("begun", "fresh")}
                given = {"folder": tmp_path, "runs": runs, "settings": "", "load_config": str, "reference": ""}
                given["apply_overrides"] = lambda config, _: config
                given["train_run"] = lambda config, run, start: started.append((run.name, start))
                (tmp_path / "begun").mkdir()
                (tmp_path / "begun" / "config.json").touch()
                training = [part for part in node.body if not names(part) & {"records", "open_run"}]
                node.iter, node.body = ast.parse("list(runs.items())").body[0].value, training
                exec(compile(ast.fix_missing_locations(ast.Module([node], [])), "cell", "exec"), given)
    assert started == [("begun", "resume"), ("fresh", "new")]


def names(expression: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(expression) if isinstance(node, ast.Name)}


def test_outputs_are_stored(notebook):
    """They are of the whole notebook, run once from top to bottom."""
    name, notebook = notebook
    codes = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in codes] == list(range(1, len(codes) + 1))
    assert pictures(notebook) >= PICTURES[name]
    assert re.search(r"\d+ validation (frames|images)", printed(notebook))
    kinds = {output.get("name", output.output_type) for cell in codes for output in cell.outputs}
    assert kinds <= {"stdout", "execute_result"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_small(path):
    assert path.stat().st_size < MOST_BYTES


def pictures(notebook):
    return sum("image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))


def printed(notebook):
    return "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))


@pytest.mark.parametrize("how", with_slow(["traced", "compiled"], quick=["traced"]))
def test_the_example_of_the_readme_runs(tmp_path, monkeypatch, how):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL | re.MULTILINE)
    names: dict = {"traced": lambda function: functools.partial(jax.eval_shape, function)}
    if how == "traced":
        code = code.replace("jax.jit(", "traced(")
    exec(compile(code, "README.md", "exec"), names)
    assert names["lanes"].points.shape == (48, 11, 3)
