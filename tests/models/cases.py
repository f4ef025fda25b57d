"""Small models and examples for the tests of the models and of training."""

import dataclasses

import numpy as np

from tests.priors.test_traffic_flow import make_flow
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lane_decoder import LaneDecoderConfig
from tflane_jax.models.toponet import TopoNetConfig, TrafficFlowConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowModuleConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.scene import Areas, Example, LaneGraph

BASELINE = TopoNetConfig(
    encoder=EvidenceEncoderConfig(dim=16, dilations=(1,)),
    decoder=LaneDecoderConfig(dim=16, heads=2, layers=2, queries=6, points=11, hidden=16, relation=8),
)
WITH_TRAFFIC = dataclasses.replace(
    BASELINE,
    traffic_flow=TrafficFlowConfig(
        prior=TrafficFlowPriorConfig(max_instances=5),
        module=TrafficFlowModuleConfig(width=8, heads=2, bands=3),
    ),
)


def make_example(seed: int = 0, instances: int = 9, lanes: int = 4) -> Example:
    """Return an example with a random raster, random tracks and straight lanes."""
    rng = np.random.default_rng(seed)
    graph = LaneGraph.empty(8, 11)
    x = np.linspace(-20, 20, 11)
    for i in range(lanes):
        graph.points[i] = np.stack([x, np.full(11, 4.0 * i - 6.0), np.zeros(11)], -1)
        graph.valid[i] = True
    graph.successor[0, 1] = lanes > 1
    return Example(
        bev=rng.integers(0, 256, (24, 40, 4), dtype=np.uint8),
        hidden=np.zeros((24, 40), bool),
        traffic_flow=make_flow(seed, instances=instances),
        markers=None,
        sd_map=None,
        lanes=graph,
        segments=LaneGraph.empty(2, 10),
        areas=Areas.empty(2, 5),
        traffic_elements=None,
        previous_from_ego=np.eye(4, dtype=np.float32),
        has_previous=np.zeros((), bool),
    )
