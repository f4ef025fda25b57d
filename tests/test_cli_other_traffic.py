"""Commands on data whose traffic flow is not that with which a model learned: they say so."""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

from tflane_jax.commands.sources import source_for
from tflane_jax.config import NuScenesData, OpenLaneV2Data, RunConfig, WorldData, load_config
from tflane_jax.datasets.base import ExampleConfig, TrafficRateWarning
from tflane_jax.datasets.nuscenes import NuScenesConfig
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.recorded_logs import RecordedConfig
from tflane_jax.datasets.sources import history_hz
from tflane_jax.runs import Run

TRAFFIC = load_config("tf_lane/toponet_tfm").task
AT_2_HZ = ExampleConfig(history_hz=2.0)


def chosen(config: RunConfig, *, data=None, root=None):
    options = argparse.Namespace(data=data, root=root, split=None, default_split="test", openlane=None, data_dict=None)
    return source_for(Run("run", config, 3, ()), options)


@pytest.mark.parametrize(
    ("config", "rate"),
    [
        (ProceduralConfig("val"), 10.0),
        (ProceduralConfig("val", example=AT_2_HZ), 2.0),
        (NuScenesConfig(Path("n")), 2.0),
        (OpenLaneV2Config(Path("n")), 0.0),
        (OpenLaneV2Config(Path("n"), example=AT_2_HZ), 0.0),
        (OpenLaneV2Config(Path("n"), tracks=Path("t")), 10.0),
        (OpenLaneV2Config(Path("n"), tracks=Path("t"), example=AT_2_HZ), 2.0),
        (OpenLaneV2Config(Path("n"), tracks=Path("t"), subset="B"), 2.0),
        (RecordedConfig(Path("n")), None),
    ],
)
def test_the_rate_of_past_frames_is_that_of_the_settings_or_of_the_tracks(config, rate):
    assert history_hz(config) == rate


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (WorldData(), "nuscenes", "are at 2 Hz in these data, and this model learned at 10 Hz"),
        (NuScenesData(Path("n")), "argoverse2", "are at 10 Hz in these data, and this model learned at 2 Hz"),
        (WorldData(), "city", "are at 2 Hz in these data, and this model learned at 10 Hz"),
        (WorldData(), "openlane-v2", "these data have no traffic flow, which this model reads: it sees none"),
    ],
)
def test_traffic_flow_unlike_that_of_the_training_is_named(tmp_path, data, name, message):
    """Regression: a model that had learned from two seconds got ten, or none, and nothing said so."""
    root = None if name == "city" else tmp_path
    with pytest.warns(TrafficRateWarning, match=message):
        chosen(RunConfig(TRAFFIC, data), data=name, root=root)


def test_what_fits_or_is_not_read_is_not_named(tmp_path):
    own = RunConfig(TRAFFIC, WorldData(example=AT_2_HZ))
    blind = replace(own, evaluation=replace(own.evaluation, traffic="none"))
    baseline = RunConfig(load_config("tf_lane/toponet").task, WorldData())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chosen(own)
        chosen(own, data="nuscenes", root=tmp_path)
        chosen(own, data="recorded", root=tmp_path)
        chosen(blind, data="openlane-v2", root=tmp_path)
        chosen(baseline, data="nuscenes", root=tmp_path)
        chosen(RunConfig(TRAFFIC, OpenLaneV2Data(Path("n"), tracks=Path("t"))), root=tmp_path)
