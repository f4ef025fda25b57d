"""Exported programs: any batch size, no model code, damaged files."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from tests.models.images import HEIGHT, WIDTH, road_image, tiny_task
from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.errors import UserError
from tflane_jax.export import image_program, largest_difference, latencies, load_program, serialized_model


@pytest.fixture(scope="module")
def program():
    task = tiny_task()
    return image_program(task, random_params(task.init, road_image(0)), height=HEIGHT, width=WIDTH)


@pytest.fixture(scope="module")
def exported(program, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "m.stablehlo"
    path.write_bytes(serialized_model(program))
    return path


def images(count):
    return np.random.default_rng(count).integers(0, 256, (count, HEIGHT, WIDTH, 3), np.uint8)


@pytest.mark.parametrize("batch", with_slow([1, 3], quick=[3]))
def test_exported_program_equals_the_model_for_any_batch_size(program, exported, batch):
    expected = jax.jit(program.call)(images(batch))
    answer = load_program(exported).call(images(batch))
    for name in ("logits", "curves"):
        np.testing.assert_allclose(answer[name], expected[name], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_exported_program_runs_without_this_package(program, exported, tmp_path):
    np.save(tmp_path / "images.npy", images(2))
    code = (
        "import sys, numpy as np; from jax import export\n"
        f"program = export.deserialize(bytearray(open({str(exported)!r}, 'rb').read()))\n"
        "answer = program.call(np.load('images.npy'))\n"
        "np.savez('answer.npz', **answer)\n"
        "assert not any(name.startswith(('tflane_jax', 'flax')) for name in sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    expected = jax.jit(program.call)(images(2))
    with np.load(tmp_path / "answer.npz") as answer:
        for name in ("logits", "curves"):
            np.testing.assert_allclose(answer[name], expected[name], rtol=1e-5, atol=1e-6)


def test_export_targets_accelerators_too(exported):
    assert load_program(exported).platforms == ("cpu", "cuda")


def test_latencies_name_every_batch_size(program, exported):
    rows = latencies(load_program(exported), program.inputs, batches=(1, 2), runs=3)
    assert [row["batch"] for row in rows] == [1, 2]
    assert all(row["ms"] > 0 for row in rows)


def test_differences_are_relative_above_one_and_leave_categories_out():
    answer = {"points": np.array([0.5, -200.0]), "category": np.array([1, 2])}
    other = {"points": np.array([0.25, -210.0]), "category": np.array([1, 0])}
    assert largest_difference(answer, other) == 0.25
    assert largest_difference(answer, answer) == largest_difference({"points": np.zeros((0, 3))}, {"points": 0}) == 0.0
    for wrong in (np.nan, np.inf):
        assert np.isnan(largest_difference(answer, other | {"points": np.array([0.5, wrong])}))


def test_bad_files_are_named(exported, tmp_path):
    with pytest.raises(UserError, match=r"nothing\.stablehlo: No such file"):
        load_program(tmp_path / "nothing.stablehlo")
    damaged = tmp_path / "damaged.stablehlo"
    for content in (b"", b"no program", exported.read_bytes()[:500]):
        damaged.write_bytes(content)
        with pytest.raises(UserError, match=r"damaged\.stablehlo is no exported program"):
            load_program(damaged)
