"""LaneSegNet with the traffic-flow module at the papers' sizes: the main host of TF-Lane.

    tflane summary --config tf_lane/lanesegnet_tfm_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/lanesegnet_tfm_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/lanesegnet_tfm_r50 --data.root PATH --data.tracks PATH \\
        --training.init-from runs/imagenet --training.init-partly

Host and labels are those of `lanesegnet_r50.py`, with the same ablations; module and tracks those of
`toponet_tfm_r50.py`.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, load_ablations, load_config
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's host with the module."""
    return _with_traffic_flow(load_config(str(HERE.with_name("lanesegnet_r50.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the variants of the host."""
    rows = load_ablations(str(HERE.with_name("lanesegnet_r50.py")))
    return {name: _with_traffic_flow(row) for name, row in rows.items()}


def _with_traffic_flow(config: RunConfig) -> RunConfig:
    """Return a configuration with the module and the tracks of `toponet_tfm_r50.py`."""
    toponet = load_config(str(HERE.with_name("toponet_tfm_r50.py")))
    assert isinstance(toponet.task, LaneGraphTask)
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(toponet.data, OpenLaneV2Data)
    assert isinstance(config.data, OpenLaneV2Data)
    model = replace(config.task.model, priors=toponet.task.model.priors)
    example = replace(
        config.data.example, history_hz=toponet.data.example.history_hz, tracks=toponet.data.example.tracks
    )
    data = replace(config.data, tracks=toponet.data.tracks, example=example)
    return replace(config, task=replace(config.task, model=model), data=data)
