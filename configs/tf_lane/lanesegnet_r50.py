"""LaneSegNet at the paper's size, on OpenLane-V2 subset A: ResNet-50, seven cameras, 200 queries.

    tflane summary --config tf_lane/lanesegnet_r50 --no-compile          # needs no data
    tflane train --config tf_lane/lanesegnet_r50 --data.root PATH

Sizes, schedule and capacity are those of TopoNet (`camera/toponet_r50`): the reference trains 24 epochs on eight GPUs,
one frame each. `:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision.
`:published_weights` evaluates as the published code does, which its weights need to reach their published numbers.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig, paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask

TOPONET = str(Path(__file__).parent.with_name("camera") / "toponet_r50.py")


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    return _segments(load_config(TOPONET), paper_config())


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder and of the evaluation."""
    rows = load_ablations(TOPONET)
    variants = {name: _segments(rows[name], paper_config()) for name in ("remat", "bfloat16")}
    return variants | {"published_weights": _segments(load_config(TOPONET), replace(paper_config(), last_step="twice"))}


def _segments(toponet: RunConfig, model: LaneSegNetConfig) -> RunConfig:
    """Return TopoNet's configuration with LaneSegNet in place of TopoNet, and its encoder."""
    assert isinstance(toponet.task, LaneGraphTask)
    losses = LaneSegNetLossConfig(raster="published")
    return replace(toponet, task=LaneGraphTask(replace(model, encoder=toponet.task.model.encoder), losses))
