"""OpenLane-V2's large baseline at its full size, on subset A: 100 queries, lanes as Bezier curves.

    tflane summary --config camera/bevformer_detr_r50 --no-compile   # needs no data
    tflane convert --config camera/bevformer_detr_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config camera/bevformer_detr_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Encoder, ablations (`:remat`, `:bfloat16`) and training are those of `toponet_r50.py`; control points, loss weights
and image sizes are the baseline's.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, load_ablations, load_config
from tflane_jax.datasets.view_images import BASELINE_LARGE
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.models.bevformer_detr import paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask

_TOPONET = str(Path(__file__).with_name("toponet_r50.py"))


def get_config() -> RunConfig:
    """Return the baseline's configuration."""
    return _baseline(load_config(_TOPONET))


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder."""
    toponet = load_ablations(_TOPONET)
    return {name: _baseline(toponet[name]) for name in ("remat", "bfloat16")}


def _baseline(toponet: RunConfig) -> RunConfig:
    assert isinstance(toponet.data, OpenLaneV2Data)
    assert isinstance(toponet.task, LaneGraphTask)
    task = LaneGraphTask(
        replace(paper_config(control_points=5), encoder=toponet.task.model.encoder), BevFormerDetrLossConfig()
    )
    return replace(toponet, task=task, data=replace(toponet.data, image=BASELINE_LARGE))
