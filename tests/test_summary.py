"""`tflane summary`: parameters, operations and memory, counted from shapes."""

import json
from dataclasses import replace

import pytest

from tests.shared import ROOT
from tests.training.stub import LineTask, line_arrays
from tests.training.stub_run import OPTIM
from tflane_jax import summary
from tflane_jax.cli import main
from tflane_jax.config import load_config
from tflane_jax.convert.hosts import camera_shapes
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.parameters import split_statistics
from tflane_jax.summary import MIB, parameter_counts, prediction_program, shapes_of_params, training_program
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.step import UpdateForm

WHOLE = UpdateForm()
LSTR = ROOT / "configs" / "gtn_lane" / "lstr.py"


def test_lstr_has_the_published_size():
    config = load_config(str(LSTR))
    example = config.task.shapes(config.data)
    learned, _ = split_statistics(shapes_of_params(config.task, example))
    assert sum(parameter_counts(learned).values()) == 765_754
    # 0.582 GMAC of convolutions and products (docs/reference/lstr.md); the rest is norms, activations and softmax.
    assert 2 * 0.582 < prediction_program(config.task, example, compiled=False).gflop < 2 * 0.582 * 1.05


def test_the_command_counts_every_parameter_once(tmp_path, capsys):
    arguments = ["summary", "--config", str(LSTR), "--no-training", "--depth", "2", "--out", str(tmp_path / "cost")]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    saved = json.loads((tmp_path / "cost.json").read_text())
    assert f"written to {tmp_path / 'cost.md'} and {tmp_path / 'cost.json'}" in printed
    assert f"{sum(saved['meta']['parameters'].values()):,}" in printed
    assert all(count > 0 for count in saved["meta"]["parameters"].values())
    (row,) = saved["rows"]
    assert row["memory, MiB"] > row["of that temporary"] > 0


def test_a_missing_config_is_named(capsys):
    assert main(["summary", "--config", "nowhere.py"]) == 2
    assert "nowhere.py does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("depth", [1, 3])
def test_depth_changes_the_listing_and_not_the_sum(depth):
    tree = {"a": {"b": {"c": _Leaf(2, 3)}, "d": _Leaf(4)}, "e": _Leaf()}
    counts = parameter_counts(tree, depth)
    assert sum(counts.values()) == 11
    assert counts == ({"a": 10, "e": 1} if depth == 1 else {"a.b.c": 6, "a.d": 4, "e": 1})


class _Leaf:
    def __init__(self, *shape: int) -> None:
        self.shape = shape


@pytest.mark.slow
def test_the_marker_papers_full_size():
    """Markers add tokens and, in each of three encoder layers, an attention and its norm: 4 (256 x 256 + 256) + 512."""
    counts = {}
    for name in ("markers/toponet_r50", "markers/toponet_r50:toponet"):
        config = load_config(name)
        assert isinstance(config.task, LaneGraphTask)
        assert isinstance(config.task.model.encoder, CameraEncoderConfig)
        assert (config.task.model.encoder.bev.layers, config.optim.lr) == (3, 1e-4)
        learned, _ = split_statistics(
            shapes_of_params(replace(config.task, clip=1), camera_shapes(config.task.model.encoder))
        )
        counts[name] = parameter_counts(learned)
    ours, toponet = counts.values()
    assert sum(toponet.values()) == 62_812_675
    assert sum(ours.values()) == 66_716_163 == 62_812_675 + ours["marker_tokens"] + 3 * 263_680


class Frames(LineTask):
    """The stub as tasks of one frame are summarised."""

    frames = 1


def test_a_state_that_is_updated_in_its_place_counts_once():
    """Regression: memory was that of two states, for a program around the update does not update in place."""
    example = {name: values[0] for name, values in line_arrays().items()}
    program = training_program(Frames(features=100_000), example, 1, OPTIM)
    one = 4 * (example["x"].size + 1) * 100_000 / MIB
    assert 4.0 < (program.memory - program.temporary) / one < 4.1  # parameters, their average and two moments


def test_a_batch_in_parts_is_planned_as_it_is_trained(monkeypatch):
    config, forms = load_config("tf_lane/toponet"), []
    task = replace(config.task, model=replace(config.task.model, decoder=replace(config.task.model.decoder, layers=1)))
    make = summary.make_update_step

    def recording(task, optim, steps, form=WHOLE):
        forms.append(form.accumulate)
        return make(task, optim, steps, form)

    monkeypatch.setattr(summary, "make_update_step", recording)
    example = task.shapes(config.data)
    whole, parts = (training_program(task, example, 4, config.optim, accumulate=n, compiled=False) for n in (1, 4))
    assert forms == [1, 4, 1]
    assert (parts.batch, parts.gflop) == (4, whole.gflop)
