"""Exported programs of lanes around the vehicle: the arrays that they read, their answers, memory."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from tests.models.cases import (
    BASELINE,
    CAMERA_TOPONET,
    SMALL_LINES,
    SMALL_SEGMENTS,
    WITH_TRAFFIC,
    make_camera_example,
    make_example,
    make_line_example,
    make_segment_example,
)
from tests.models.test_marker_fusion import CONFIG, observed, seeing
from tests.parameters import random_params
from tests.slow import with_slow
from tests.tiny_run import CONFIG as TINY
from tflane_jax.cli import main
from tflane_jax.export import MEMORY, scene_program, serialized_model
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.answers import answer_arrays
from tflane_jax.tasks.lane_graph import LaneGraphTask

TRAFFIC = {f"traffic_flow/{name}" for name in ("position", "yaw", "size", "category", "occluded", "valid")}
VIEWS = {f"cameras/{name}" for name in ("image", "size", "intrinsics", "camera_from_ego", "valid")}
GRAPH = {"points", "scores", "successor"}
CASES = {
    "baseline": (BASELINE, make_example, {"bev"}, GRAPH),
    "traffic": (WITH_TRAFFIC, make_example, {"bev", *TRAFFIC}, GRAPH),
    "segments": (SMALL_SEGMENTS, make_segment_example, {"bev", *TRAFFIC}, {*GRAPH, "left", "right", "category"}),
    "lines": (SMALL_LINES, make_line_example, {"bev", *TRAFFIC}, {"points", "scores", "category"}),
    "cameras": (
        CAMERA_TOPONET,
        make_camera_example,
        {*VIEWS, *TRAFFIC},
        {*GRAPH, "box", "attribute_score", "element_lane"},
    ),
}
STREAM = LaneGraphTask(replace(BASELINE, priors=replace(BASELINE.priors, markers=CONFIG)), clip=2)


def exported(program):
    return export.deserialize(serialized_model(program))


def assert_close(found, expected):
    """Two compiled programs of one model differ by rounding, which its layers amplify."""
    for name, array in expected.items():
        scale = max(float(np.abs(array).max(initial=0.0)), 1.0)  # points are in metres, up to 50
        np.testing.assert_allclose(found[name], array, rtol=0.0, atol=1e-4 * scale, err_msg=name)


def arrays_of(example, names):
    """Return leaves of an example by their names."""
    found = {}
    for name in names:
        leaf = example
        for part in name.split("/"):
            leaf = getattr(leaf, part)
        found[name] = np.asarray(leaf)
    return found


@pytest.mark.parametrize("name", with_slow(list(CASES), quick=["traffic"]))
def test_a_program_reads_what_its_model_reads_and_answers_like_it(name):
    model, make, inputs, answers = CASES[name]
    task, batch = LaneGraphTask(model), stack_examples([make(seed) for seed in range(3)])
    params = random_params(task.init, make(0), spread=0.1)
    program = scene_program(task, params, make(0))
    assert program.inputs.keys() == inputs
    answer = exported(program).call(arrays_of(batch, inputs))
    assert answers <= answer.keys() <= {*answers, "left_type", "right_type"}
    expected = answer_arrays(jax.jit(jax.vmap(task.predict, (None, 0)))(params, batch))
    assert_close(answer, expected)


def test_a_program_carries_memory_from_frame_to_frame():
    # Only the first frame shows a marker.
    frames = [seeing(observed(seed=i, valid=i == 0), i, has_previous=np.asarray(i > 0)) for i in range(2)]
    params = random_params(STREAM.init, stack_examples(frames))
    program = scene_program(STREAM, params, frames[0])
    names = {name for name in program.inputs if not name.startswith(MEMORY)}
    assert names == {"bev", "previous_from_ego", "has_previous"} | {
        f"markers/{name}" for name in ("pose", "residual", "lanes", "lane_valid", "successor", "valid")
    }
    call = exported(program).call
    carried = {
        name: np.full_like(array, np.nan if array.dtype.kind == "f" else 1)[None]
        for name, array in program.inputs.items()
        if name.startswith(MEMORY)
    }
    memory, step = STREAM.start(), jax.jit(STREAM.step)
    for frame in frames:
        answer = call(arrays_of(jax.tree.map(lambda leaf: np.asarray(leaf)[None], frame), names) | carried)
        carried = {name: array for name, array in answer.items() if name.startswith(MEMORY)}
        memory, prediction = step(params, memory, frame)
        expected = answer_arrays(prediction)
        assert answer.keys() - carried.keys() == expected.keys()
        assert_close({name: array[0] for name, array in answer.items()}, expected)
    alone = answer_arrays(jax.jit(STREAM.predict)(params, frames[1]))
    assert np.abs(alone["points"] - answer["points"][0]).max() > 1e-2


def test_answers_of_numpy_are_numpy():
    task = LaneGraphTask(BASELINE)
    params = random_params(task.init, make_example())
    prediction = jax.jit(task.predict)(params, make_example())
    ours = answer_arrays(jax.device_get(prediction))
    assert {type(array) for array in ours.values()} == {np.ndarray}
    for name, array in answer_arrays(prediction).items():
        assert isinstance(array, jnp.ndarray)
        np.testing.assert_allclose(array, ours[name], rtol=1e-6, atol=1e-6)
    without = prediction.replace(centerlines=prediction.centerlines.replace(successor_logits=None))
    assert not answer_arrays(without)["successor"].any()


@pytest.mark.slow
def test_the_command_writes_the_program_its_latencies_and_an_example(tmp_path, capsys):
    (tmp_path / "tiny.py").write_text(TINY)
    small = ["--data.train", "2", "--data.val", "1", "--data.test", "1", "--training.steps", "2"]
    run, out = tmp_path / "run", tmp_path / "out" / "tiny.stablehlo"
    assert main(["train", "--config", str(tmp_path / "tiny.py"), "--out", str(run), *small]) == 0
    assert main(["export", str(run), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "| traffic_flow/position " in said
    assert "the model's numbers" in said
    assert sorted(path.name for path in out.parent.iterdir()) == [
        f"tiny.{kind}" for kind in ("json", "md", "npz", "stablehlo")
    ]
    with np.load(out.with_suffix(".npz")) as file:
        inputs = {name: file[name][None] for name in file.files if not name.startswith("answer/")}
        answer = export.deserialize(bytearray(out.read_bytes())).call(inputs)
        assert_close({name: array[0] for name, array in answer.items()}, {n: file[f"answer/{n}"] for n in answer})
    for other in ("tiny.npz", "tiny.json"):
        assert main(["export", str(run), "--out", str(tmp_path / other)]) == 2
        assert "a file beside the program has this name" in capsys.readouterr().err
