"""A new host costs a file in models/ and one in losses/: everything else takes it as it is."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.evaluation.test_lane_graph import labelled
from tests.models.cases import BASELINE
from tests.models.toy_host import ToyHostConfig, ToyHostLossConfig
from tests.parameters import random_params
from tflane_jax.config import RunConfig, WorldData
from tflane_jax.config_io import from_json, to_json, to_text
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

FLOW = TrafficFlowConfig(
    TrafficFlowPriorConfig(frames=4, min_valid_frames=1), TrafficFlowModuleConfig(width=8, heads=2, bands=3)
)
HOST = ToyHostConfig(
    encoder=EvidenceEncoderConfig(dim=16, cell=2, dilations=(1,)), priors=PriorsConfig(traffic_flow=FLOW)
)
TASK = LaneGraphTask(HOST, ToyHostLossConfig())
CONFIG = RunConfig(task=TASK)


@pytest.fixture(scope="module")
def params():
    return random_params(TASK.init, labelled())


def test_it_learns(params):
    batch = jax.tree.map(jnp.asarray, stack_examples([labelled(i) for i in range(2)]))
    gradient, terms = jax.jit(jax.grad(TASK.loss, has_aux=True))(params, batch, jax.random.key(0))
    assert set(terms) == {"points"}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.abs(gradient["queries"]).max() > 0
    assert np.abs(gradient["temporal_encoder"]["frame"]["kernel"]).max() > 0  # a prior, too


def test_it_is_evaluated_by_its_own_protocol(params):
    data = stack_examples([labelled(i) for i in range(3)])
    found = TASK.evaluate(params, data, EvaluationConfig(batch_size=2))
    assert "MapTR" in found.protocol
    assert {name.partition(" ")[0] for name in found.groups} == {"lines"}
    assert {"lines occluded", "lines hidden+traffic"} <= set(found.groups)
    example = ExampleConfig(map_lines=MapLinesConfig(centerlines="include"))
    assert set(found.scores()) <= TASK.score_names(WorldData(example=example), EvaluationConfig())
    derived = TASK.evaluate(params, data.replace(map_lines=None), EvaluationConfig(batch_size=2))
    assert set(derived.scores()) <= TASK.score_names(WorldData(), EvaluationConfig())
    assert set(derived.groups) == {"lines"}
    assert {"map_lines", "segments", "areas", "traffic_flow"} <= set(TASK.parts)


def test_its_configuration_is_saved_read_and_overridden():
    assert from_json(RunConfig, json.loads(json.dumps(to_json(CONFIG)))) == CONFIG
    assert "task.model = ToyHostConfig" in to_text(CONFIG)
    changed = apply_overrides(CONFIG, ["--task.model.queries", "7", "--task.model.priors.traffic_flow", "None"])
    assert changed.task.model == replace(HOST, queries=7, priors=PriorsConfig())
    chosen = apply_overrides(RunConfig(), ["--task.model", "ToyHostConfig", "--task.losses", "ToyHostLossConfig"])
    assert chosen.task == LaneGraphTask(ToyHostConfig(), ToyHostLossConfig())
    assert LaneGraphTask(BASELINE) != TASK
