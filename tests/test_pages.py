"""The pages: commands that the parsers take, and links to headings that exist."""

import re
import shlex
import sys
import types
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from tests.models.cases import BASELINE, make_example
from tests.parameters import random_params
from tests.shared import ROOT
from tests.training.stub import LineDataset, LineTask, line_arrays
from tflane_jax.cli import build_parser
from tflane_jax.commands.sources import source_for
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.procedural import STREET_EXAMPLE
from tflane_jax.errors import UserError
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.run_checks import check_run
from tflane_jax.runs import check_origin
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.fit import check_settings_fit
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.schedule import make_optimizer

PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of the `tflane` commands in blocks of code; those with shell variables or "..." are left out."""
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        if language:
            continue
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True) if line.startswith("tflane ") else []
            if words and not any("..." in word or set(word) & set("${[") for word in words):
                yield words[1:]


def fault(words: list[str]) -> str | None:
    """Return what is wrong with a command, None if it parses with all its settings."""
    try:
        options, rest = build_parser().parse_known_args(words)
        if rest and not options.takes_overrides:
            return f"unknown argument {rest[0]}"
        if rest and options.command not in ("compare", "sweep"):  # of these, the settings are for any configuration
            config = getattr(options, "config", None)
            made = apply_overrides(RunConfig() if config is None else _config(config), rest)
            if options.command == "train":
                check_frozen(made)
    except SystemExit as error:
        return "wrong arguments" if error.code else None
    except UserError as error:
        return str(error)
    return None


_config = cache(load_config)


def check_frozen(config: RunConfig) -> None:
    """Raise UserError for frozen modules without weights; the run to start from need not exist."""
    if config.training.init_from is None:
        check_origin(config)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub names them."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_commands_in_pages_parse():
    found = [(page, words) for page, text in PAGES.items() for words in commands(text)]
    assert len(found) > 110, "hardly anything found: has the pattern changed?"
    wrong = {f"{page}: tflane {shlex.join(words)}": said for page, words in found if (said := fault(words))}
    assert wrong == {}


def test_the_first_training_of_the_readme_is_not_refused():
    (words,) = [words for words in commands(PAGES["README.md"]) if "runs/first" in words]
    options, rest = build_parser().parse_known_args(words)
    config = apply_overrides(load_config(options.config), rest)
    check_run(config)
    make_optimizer(config.optim, config.training.steps)  # refuses a warm-up that does not end


def test_trainings_of_the_page_on_32_devices_can_share_their_batches():
    """Regression: they kept the batch of eight of their configuration, and were refused."""
    text = PAGES["docs/scale.md"].replace("\\\n", " ")
    lines = re.findall(r"^(?:srun .*)?(tflane train --config .*(?:--processes 4|--distributed).*)$", text, re.MULTILINE)
    assert len(lines) == 2
    for line in lines:
        options, rest = build_parser().parse_known_args(shlex.split(line)[1:])
        config = apply_overrides(_config(options.config), rest)
        assert (config.training.batch_size % 32, config.evaluation.batch_size % 32) == (0, 0)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("train --config tf_lane/argoverse2 --data.root LOGS", "unknown setting --data.root"),
        ("train --config camera/toponet_r50 --data.root ROOT", "would stay random"),
        ("train --config markers/toponet_r50 --task.model.encoder.bev.remat True", "is a flag without a value"),
        ("data stats --data argoverse2 --root LOGS --data.example.history-hz 2", "data.world.keyframes"),
        ("eval RUN --evaluation.versions v1.0", "unknown argument --evaluation.versions"),
        ("predict RUN --split all", "wrong arguments"),
    ],
)
def test_wrong_commands_are_found(command, said):
    (words,) = commands(f"```\ntflane {command}    # a remark\n```\n")
    assert said in (fault(words) or "")


@pytest.mark.usefixtures("own_sources")
def test_configurations_in_pages_can_be_trained():
    found = 0
    for text in PAGES.values():
        for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            if re.search(r"import .*RunConfig", block) and "def get_config" in block:
                check_frozen(defined(block)["get_config"]())
                found += 1
    assert found > 1


def test_the_host_of_the_page_has_losses_and_gradients():
    """Regression: the page lacked imports and an argument."""
    (block,) = python_blocks("docs/architecture.md", "class PlainDetr(Host)")
    config = defined(block)["get_config"]()
    example = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), config.task.shapes(config.data))
    batch = jax.tree.map(lambda leaf: leaf[None], example)

    def trained(key):
        params = config.task.init(key, example)
        return jax.grad(config.task.loss, has_aux=True)(params, batch, key), config.task.predict(params, example)

    (_, terms), prediction = jax.eval_shape(trained, jax.random.key(0))
    assert "points" in terms
    assert prediction.centerlines.points.shape == (50, 11, 3)


@pytest.mark.usefixtures("own_sources")
def test_the_dataset_of_the_page_is_read_trained_on_and_checked(tmp_path, monkeypatch):
    """Regression: it took its own sizes in place of the run's, and could not be copied from the tests."""
    (block,) = python_blocks("docs/architecture.md", "class MyDataset")
    names = defined(block)
    monkeypatch.chdir(tmp_path)
    config = names["get_config"]()
    grid = config.data.example.sensor.grid
    lines = [[[-30.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]]]
    for split in ("train", "val", "test"):
        folder = tmp_path / "drives" / split
        folder.mkdir(parents=True)
        np.savez(folder / "0.npz", lines=lines, bev=np.zeros((grid.rows, grid.columns, 4), np.uint8))
    assert sources.named_source("mine").check(tmp_path / "drives").faults == []
    check_run(config)
    loaded = config.task.load(config.data.source("train"), progress=False)
    config.task.check(config.data, loaded)
    for wrong in (loaded.bev[:, ::2], loaded.bev[..., :3]):
        with pytest.raises(UserError, match=r"examples of mine-train have a raster of .* says 100 x 200 x 4"):
            config.task.check(config.data, replace(loaded, bev=wrong))
    lanes = loaded.lanes.replace(points=2.0 * loaded.lanes.points)  # 60 m ahead, in a box of 50
    with pytest.warns(TruncationWarning, match=r"of the points of lanes in mine-train lie outside x \(-5.*cut lanes"):
        config.task.check(config.data, replace(loaded, lanes=lanes))
    assert loaded.lanes.successor[0, 0, 1]
    assert loaded.lanes.valid.sum() == 2
    trained = load_config("tf_lane/toponet:street")  # another box
    choice = names["Choice"]("test", False, trained.data.source("test"), tmp_path / "drives")
    assert names["choose"](choice).example == trained.data.example
    run = SimpleNamespace(config=trained)
    options = {"data": "mine", "root": str(tmp_path / "drives"), "openlane": None, "split": None, "data_dict": None}
    with pytest.raises(UserError, match="a raster of 100 x 200 x 4"):
        source_for(run, SimpleNamespace(default_split="test", **options))


def defined(block: str) -> dict[str, Any]:
    """Run a block of Python as a module, and return its names."""
    module = types.ModuleType("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "page", module)  # where dataclasses look for it
        exec(block, module.__dict__)
    return module.__dict__


def test_commands_behind_blocks_of_python_are_found():
    """The end of a Python block looks like the begin of one without a language."""
    text = "```python\nx = 1\n```\n\n```\ntflane bench\n```\n\n```\ntflane demo\n```\n"
    assert list(commands(text)) == [["bench"], ["demo"]]


def test_links_lead_to_headings():
    for page, text in PAGES.items():
        for path, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#([^)\s]+)\)", text):
            target = (ROOT / page).parent.joinpath(path).resolve() if path else ROOT / page
            assert anchor in anchors(target.read_text("utf-8")), f"{page} links to {path}#{anchor}"


def test_the_training_loop_of_the_page_trains(monkeypatch):
    """It runs with a small task that has running statistics."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGES["docs/predictions.md"], re.DOTALL | re.MULTILINE)
    (code,) = [block for block in blocks if "optimizer" in block]
    task = LineTask()
    config = SimpleNamespace(task=task, data=SimpleNamespace(source=lambda split: split))
    monkeypatch.setattr("tflane_jax.config.load_config", lambda name: config)
    monkeypatch.setattr(sources, "open_dataset", lambda split: LineDataset())
    names: dict[str, Any] = {}
    exec(compile(code, "predictions.md", "exec"), names)
    start, end = task.init(jax.random.key(0), LineDataset().example(0)), names["params"]
    before, after = (float(task.loss(params, line_arrays(), jax.random.key(0))[0]) for params in (start, end))
    assert after < before
    assert (end[STATISTICS]["mean"] != start[STATISTICS]["mean"]).all()


def python_blocks(page: str, word: str) -> list[str]:
    """Return the blocks of Python of a page that contain a word."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGES[page], re.DOTALL | re.MULTILINE)
    return [block for block in blocks if word in block]


def test_the_own_metric_of_the_page_runs(monkeypatch, capsys):
    (code,) = python_blocks("docs/predictions.md", "differences")
    task = LaneGraphTask(BASELINE)
    example = make_example(0)
    run = SimpleNamespace(task=task, data=SimpleNamespace(source=lambda split: split))
    opened = SimpleNamespace(config=run, params=[random_params(task.init, example)])
    monkeypatch.setattr("tflane_jax.runs.open_run", lambda folder: opened)
    monkeypatch.setattr(sources, "load", lambda split: stack_examples([example, make_example(1), make_example(2)]))
    names: dict[str, Any] = {}
    exec(compile(code, "predictions.md", "exec"), names)
    assert len(names["differences"]) == 3
    assert capsys.readouterr().out.startswith("mean difference of the number of lanes ")


def test_the_examples_of_the_page_are_valid():
    names: dict[str, Any] = {}
    code, of_a_log = python_blocks("docs/your_data.md", "example")
    exec(compile(code, "your_data.md", "exec"), names)
    arrays = names["example"]
    exec(compile(of_a_log, "your_data.md", "exec"), names)
    made = names["example"]
    made.validate()
    for name in ("bev", "traffic_flow", "lanes", "segments", "areas"):
        assert jax.tree.map(np.shape, getattr(arrays, name)) == jax.tree.map(np.shape, getattr(made, name)), name
    assert (arrays.lanes.valid.sum(), made.lanes.valid.sum()) == (2, 1)
    for example in (arrays, made):
        assert example.traffic_flow.valid.any(1).sum() == 1


@pytest.mark.parametrize(
    ("name", "example"),
    [("tf_lane/toponet", "ExampleConfig()"), ("tf_lane/toponet_tfm", "ExampleConfig()")]
    + [(f"tf_lane/{name}", "STREET_EXAMPLE") for name in ("toponet:street", "toponet_tfm:street_bev")],
)
def test_the_box_that_the_page_names_is_that_of_the_configuration(name, example):
    assert f"`{example}`" in PAGES["docs/your_data.md"]
    box = {"ExampleConfig()": ExampleConfig(), "STREET_EXAMPLE": STREET_EXAMPLE}[example]
    check_settings_fit(load_config(name).task.model, box, image_scale=None)
