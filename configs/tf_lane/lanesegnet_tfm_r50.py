"""LaneSegNet with the traffic-flow module at the papers' sizes: the host of TF-Lane's ablations.

    tflane summary --config tf_lane/lanesegnet_tfm_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/lanesegnet_tfm_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/lanesegnet_tfm_r50 --data.root PATH --data.tracks PATH \\
        --training.init-from runs/imagenet --training.init-partly

Host and labels are those of `lanesegnet_r50.py`, with the same ablations; module, tracks and epochs those of
`toponet_tfm_r50.py`. `:host` is the baseline without the module.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, epochs_of, load_ablations, load_config, with_epochs
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)
HOST = str(HERE.with_name("lanesegnet_r50.py"))
EPOCHS = epochs_of(load_config(str(HERE.with_name("toponet_tfm_r50.py"))))


def get_config() -> RunConfig:
    """Return the paper's host with the module."""
    return _with_traffic_flow(load_config(HOST))


def ablations() -> dict[str, RunConfig]:
    """Return the variants of the host, and the host alone."""
    rows = {name: _with_traffic_flow(row) for name, row in load_ablations(HOST).items()}
    return rows | {"host": with_epochs(load_config(HOST), EPOCHS)}


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
    return with_epochs(replace(config, task=replace(config.task, model=model), data=data), EPOCHS)
