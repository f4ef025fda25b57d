"""A program in which the toy dataset is listed; `test_sources` runs it in a process of its own.

Arguments: a copy of datasets/sources.py with the toy's entry, and an empty folder to work in.
"""

import contextlib
import importlib.util
import io
import json
import sys
from pathlib import Path


def main(listed: Path, folder: Path) -> None:
    spec = importlib.util.spec_from_file_location("tflane_jax.datasets.sources", listed)
    assert spec is not None
    assert spec.loader is not None
    import tflane_jax.datasets as package

    package.sources = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # pyright: ignore
    spec.loader.exec_module(package.sources)

    data = folder / "toys"
    data.mkdir()
    for split, count in (("train", 4), ("val", 2), ("test", 3)):
        (data / f"{split}.txt").write_text(str(count))
    configuration(data)
    training_data(data)
    commands(data, folder)


def configuration(data: Path) -> None:
    from tests.datasets.toy_source import ToyData
    from tflane_jax.config import RunConfig
    from tflane_jax.config_io import from_json, to_json
    from tflane_jax.config_overrides import apply_overrides

    config = RunConfig(data=ToyData(data))
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    moved = apply_overrides(config, ["--data.root", "elsewhere", "--optim.lr", "0.5"])
    assert (moved.data, moved.optim.lr) == (ToyData(Path("elsewhere")), 0.5)


def training_data(data: Path) -> None:
    import numpy as np

    from tests.datasets.toy_source import ToyData
    from tests.fakes import fake_example
    from tflane_jax.config import RunConfig
    from tflane_jax.datasets import sources
    from tflane_jax.datasets.batches import batches

    config = RunConfig(data=ToyData(data))
    loaded = sources.load(config.data.source("train"), progress=False)
    assert loaded.lanes.points.shape[0] == 4
    np.testing.assert_array_equal(loaded.lanes.points[3], fake_example(3).lanes.points)
    assert loaded.hidden is None  # no training part
    ((batch,),) = batches(loaded, (0,), range(1), 2)
    assert batch.lanes.valid.shape[:2] == (2, 5)
    assert sources.sample(config.data.source("train")).lanes.points.shape == loaded.lanes.points.shape[1:]


def commands(data: Path, folder: Path) -> None:
    run, root = model(folder), ["--data", "toy", "--root", str(data)]
    text = tflane("data", "show", *root, "--split", "val", "--count", "2", "--out", str(folder / "toys.png"))
    assert "toy-val-toys: the 2 examples drawn" in text
    assert (folder / "toys.png").is_file()

    text = tflane("data", "check", "--format", "toy", str(data))
    assert "Toy" in text
    assert "faults" not in text

    for split, frames in (("test", 3), ("val", 2), ("train", 4)):
        text = tflane("eval", str(run), *root, "--split", split, "--out", str(folder / split))
        assert f"toy-{split}" in text
        rows = json.loads((folder / f"{split}.json").read_text())["rows"]
        assert rows[0]["frames"] == frames

    (data / "test.txt").unlink()
    assert "test.txt is missing" in tflane("eval", str(run), *root, code=2)
    assert "1 fault:" in tflane("data", "check", "--format", "toy", str(data), code=2)
    assert "needs --root PATH, the toy's folder" in tflane("eval", str(run), "--data", "toy", code=2)


def model(folder: Path) -> Path:
    """Write a run whose model gives a fixed prediction, which compiles in no time."""
    import jax
    import jax.numpy as jnp

    from tests.fakes import fake_prediction
    from tflane_jax.config import RunConfig
    from tflane_jax.runs import write_weights
    from tflane_jax.scene import Prediction
    from tflane_jax.tasks.lane_graph import LaneGraphTask

    def predict(task, params, example):
        return Prediction(centerlines=jax.tree.map(jnp.asarray, fake_prediction(0)))

    LaneGraphTask.predict = predict  # pyright: ignore[reportAttributeAccessIssue]
    write_weights(RunConfig(), {"shift": jnp.zeros(3)}, folder / "run")
    return folder / "run"


def tflane(*arguments: str, code: int = 0) -> str:
    """Run a command, which must end with this code, and return what it printed."""
    from tflane_jax.cli import main

    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        found = main(arguments)
    assert found == code, text.getvalue()
    return text.getvalue()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
