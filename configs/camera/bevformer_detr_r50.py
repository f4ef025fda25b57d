"""OpenLane-V2's large baseline at its full size, on subset A: 100 queries, lanes as Bezier curves.

    tflane summary --config camera/bevformer_detr_r50 --no-compile   # needs no data
    tflane convert --config camera/bevformer_detr_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config camera/bevformer_detr_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Encoder and training are those of `toponet_r50.py`; control points, loss weights, image sizes and augmentation (without
GridMask) are the baseline's. As there, logs whose streets differ from their map and frames without lanes are kept. The
published code distorts images after normalising them, by up to 32 standard deviations; here they are distorted before.
`:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, load_config, with_remat
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.view_images import BASELINE_LARGE
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.losses.traffic_elements import ElementLossConfig
from tflane_jax.models.bevformer_detr import paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask


def get_config() -> RunConfig:
    """Return the baseline's configuration."""
    toponet = load_config(str(Path(__file__).with_name("toponet_r50.py")))
    assert isinstance(toponet.data, OpenLaneV2Data)
    assert isinstance(toponet.task, LaneGraphTask)
    losses = BevFormerDetrLossConfig(class_mean="frame", elements=ElementLossConfig(empty_frames="skip"))
    model = replace(paper_config(control_points=5), encoder=toponet.task.model.encoder)
    data = replace(toponet.data, image=BASELINE_LARGE, augmentation=PhotometricConfig(), map_changes="keep")
    return replace(toponet, task=LaneGraphTask(model, losses, empty_frames="keep"), data=data)


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder."""
    return {"remat": with_remat(get_config()), "bfloat16": with_remat(get_config(), "bfloat16")}
