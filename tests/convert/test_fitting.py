"""Converted variables against those of a model, with auxiliary heads that only one of them has."""

import numpy as np
import pytest

from tflane_jax.convert.fitting import Expected, fitted
from tflane_jax.convert.renaming import Converted, without
from tflane_jax.errors import UserError

WEIGHT, MASK, CELLS = np.ones((2, 3)), np.ones((3, 3)), np.full((4,), 5.0)


def converted(**params):
    rows = [{"tensor": f"t.{name}", "shape": "", "becomes": f"{name}/kernel"} for name in params]
    tree = {name: {"kernel": value} for name, value in params.items()}
    return Converted({"params": tree, "batch_stats": {"norm": {"mean": np.zeros(2)}}}, rows)


def model(*auxiliary, **params):
    whole = {"params": {k: {"kernel": v} for k, v in params.items()}, "batch_stats": {"norm": {"mean": np.zeros(2)}}}
    needed = without(whole, [f"params/{name}/kernel" for name in auxiliary])
    return Expected(lambda: whole, whole, needed)


def test_equal_trees_fit():
    params, table = fitted(converted(out=WEIGHT), model(out=WEIGHT), "w.npz", "left out")
    assert params["out"]["kernel"] is WEIGHT
    assert params["batch_stats"]["norm"]["mean"].shape == (2,)
    assert [row["becomes"] for row in table] == ["out/kernel"]


def test_a_head_that_only_the_file_has_is_left_out():
    params, table = fitted(converted(out=WEIGHT, mask_head=MASK), model(out=WEIGHT), "w.npz", "left out")
    assert set(params) == {"out", "batch_stats"}
    assert table[1]["becomes"] == "an auxiliary head that the model does not have, left out"


def test_a_head_that_only_the_model_has_starts_afresh_or_is_left_out():
    expected = model("cells", out=WEIGHT, cells=CELLS)
    params, table = fitted(converted(out=WEIGHT), expected, "w.npz", "fresh")
    assert params["cells"]["kernel"] is CELLS
    assert table[-1]["becomes"] == "cells/kernel starts afresh: an auxiliary head that the file does not have"
    params, table = fitted(converted(out=WEIGHT), expected, "w.npz", "left out")
    assert set(params) == {"out", "batch_stats"}
    assert table[-1]["becomes"].startswith("cells/kernel is left out")


def test_parameters_without_a_tensor_are_told_from_heads():
    expected = model(out=WEIGHT, scores=CELLS)
    with pytest.raises(UserError, match=r"w.npz does not fit the model: params/scores/kernel is absent in the file"):
        fitted(converted(out=WEIGHT), expected, "w.npz", "fresh")
    params, table = fitted(converted(out=WEIGHT), expected, "w.npz", "fresh", unmapped="params/scores/.*")
    assert params["scores"]["kernel"] is CELLS
    assert table[-1]["becomes"] == "scores/kernel starts afresh: no such tensor in the file"


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ({"other": WEIGHT}, r"other/kernel is 2x3 in the file and absent in the model"),
        ({"out": WEIGHT.T}, r"out/kernel is 3x2 in the file and 2x3 in the model"),
        ({"out": WEIGHT, "head": MASK}, r"head/kernel is 3x3 in the file and absent in the model"),
    ],
)
def test_everything_else_must_fit(file, message):
    with pytest.raises(UserError, match=message):
        fitted(converted(**file), model(out=WEIGHT), "w.npz", "fresh")
