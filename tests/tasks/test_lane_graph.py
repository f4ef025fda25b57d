"""The task of lane graphs as the program around the training loop sees it."""

from dataclasses import replace

import pytest

from tests.models.cases import BASELINE, make_example
from tflane_jax.config import RunConfig, WorldData
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask, limit_instances
from tflane_jax.world.bev.sensor import BevSensorConfig

WIDE = PerceptionRange((-60.0, 60.0), (-30.0, 30.0))
EXAMPLES = stack_examples([make_example()])


def test_shipped_ranges_fit():
    RunConfig().task.check(WorldData(), EXAMPLES)


def test_a_raster_of_another_range_is_named():
    sensor = BevSensorConfig(grid=replace(BevGrid(), range=WIDE))
    data = WorldData(example=ExampleConfig(sensor=sensor))
    with pytest.raises(UserError, match=r"x \(-60\.0, 60\.0\).*task\.model\.encoder\.range"):
        LaneGraphTask(TopoNetConfig()).check(data, EXAMPLES)
    model = TopoNetConfig(encoder=replace(TopoNetConfig().encoder, range=WIDE))
    LaneGraphTask(model).check(data, EXAMPLES)


def test_truth_beyond_the_bev_features_is_named():
    data = WorldData(example=ExampleConfig(range=WIDE))
    with pytest.raises(UserError, match=r"data\.example\.range.*BEV features"):
        LaneGraphTask(TopoNetConfig()).check(data, EXAMPLES)


def test_limiting_instances_needs_traffic_flow():
    with pytest.raises(UserError, match="baseline without traffic flow"):
        limit_instances(LaneGraphTask(BASELINE), 3)
