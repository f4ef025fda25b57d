"""Which edge types graph encoders use: the numbers, their table and their picture."""

import json

import jax
import numpy as np
import pytest

from tests.models.images import road_image, road_images, tiny_task
from tests.parameters import random_params
from tflane_jax.evaluation.edge_types import edge_types
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.tasks.base import Model
from tflane_jax.tasks.edge_types import save_edge_types

GTN = GtnEncoderConfig(layers=1, hidden=16, relations=("self", "up", "row"))


def random_model(encoder):
    task = tiny_task(encoder)
    return Model(task, random_params(task.init, road_image(0)))


def test_the_edge_types_of_a_gtn_are_its_selection(tmp_path):
    model, images = random_model(GTN), road_images(1)
    scores = np.array([[[0, 1, 2, 9], [3, 0, 0, 9]], [[0, 0, 0, 2], [1, 0, 0, 0]]], np.float32)
    model.params["encoder"]["layer_0"]["graph"]["selection"] = scores
    found = edge_types(model.task.model, model.params, images)
    assert found.names == ("self", "up", "row", "similarity")
    first = np.array(jax.nn.softmax(scores[0, :, :3], -1))  # similarity is offered to the last hop alone
    np.testing.assert_allclose(found.layers[0][0, :, :3], first, rtol=1e-5)
    assert np.isnan(found.layers[0][0, :, 3]).all()
    np.testing.assert_allclose(found.layers[0][1], jax.nn.softmax(scores[1], -1), rtol=1e-5)

    models = {"ours": model, "plain": Model(tiny_task(), {}), "gcn": Model(tiny_task(GcnEncoderConfig()), {})}
    written = save_edge_types(models, images, tmp_path / "edge.types")
    assert [path.name for path in written] == ["edge.types.md", "edge.types.json", "edge.types.png"]
    rows = json.loads(written[1].read_text())["rows"]
    assert [(row["layer"], row["hop"], row["channel"], row["wins"]) for row in rows] == [
        (1, 1, 1, "row"),
        (1, 1, 2, "self"),
        (1, 2, 1, "similarity"),
        (1, 2, 2, "self"),
    ]
    assert "similarity" not in rows[0]
    assert {row["model"] for row in rows} == {"ours"}


def test_encoders_that_choose_nothing_have_no_files(tmp_path):
    assert save_edge_types({"plain": Model(tiny_task(), {})}, road_images(1), tmp_path / "edges") == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_meta_paths_of_a_han_are_means_over_images():
    layers, relations = 2, ("near", "near+row")
    model = random_model(HanEncoderConfig(layers=layers, hidden=16, semantic=8, relations=relations))
    images = road_images(3)
    found = edge_types(model.task.model, model.params, images)
    assert (found.names, len(found.layers)) == (relations, layers)
    alone = [
        edge_types(model.task.model, model.params, jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], images))
        for i in range(3)
    ]
    for layer, each in zip(found.layers, zip(*(one.layers for one in alone), strict=True), strict=True):
        np.testing.assert_allclose(layer, np.mean(each, 0), rtol=1e-4)
        np.testing.assert_allclose(layer.sum(-1), 1.0, rtol=1e-5)
        assert np.ptp(each, axis=0).max() > 0
