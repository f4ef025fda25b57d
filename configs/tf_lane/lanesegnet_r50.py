"""LaneSegNet at the paper's size, on OpenLane-V2 subset A: ResNet-50, seven cameras, 200 queries.

    tflane summary --config tf_lane/lanesegnet_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/lanesegnet_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/lanesegnet_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Sizes, schedule and capacity are those of TopoNet (`camera/toponet_r50`): the reference trains 24 epochs on eight GPUs,
one frame each. `:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision.
`:published_weights` evaluates as the published code does, which its weights need to reach their published numbers: each
frame alone, with the numbers of its pose that the weights read (`datasets.openlane_can_bus`), pixels of all cameras
divided by the size of the front camera's crop, and the last layer's change of the centerline applied twice.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, load_ablations, load_config
from tflane_jax.datasets.photometric import LANESEGNET_PHOTOMETRIC
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
    published = _segments(rows["published_weights"], replace(paper_config(), last_step="twice"))
    return variants | {"published_weights": published}


def _segments(toponet: RunConfig, model: LaneSegNetConfig) -> RunConfig:
    """Return TopoNet's configuration, its encoder included, with LaneSegNet, its labels and its augmentation."""
    assert isinstance(toponet.task, LaneGraphTask)
    assert isinstance(toponet.data, OpenLaneV2Data)
    model = replace(model, encoder=toponet.task.model.encoder)
    losses = LaneSegNetLossConfig(raster="published", class_mean="frame")
    task = LaneGraphTask(model, losses, empty_frames="skip")
    example = replace(toponet.data.example, crossings="sides")
    data = replace(
        toponet.data,
        flavour="lane_segment",
        example=example,
        augmentation=LANESEGNET_PHOTOMETRIC,
    )
    return replace(toponet, task=task, data=data, training=replace(toponet.training, best_metric="all/mAP"))
