"""LaneSegNet's map-element-bucket variant at its size: segments, areas and traffic elements, on OpenLane-V2 subset A.

    tflane summary --config tf_lane/lanesegnet_bucket_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/lanesegnet_bucket_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/lanesegnet_bucket_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Six encoder layers, images times 0.33, no photometric distortion, only the GridMask. Crossings are areas, no
segments. `:published_fault` predicts areas as the published code does, without the reference that its decoder refines.
`:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig, load_ablations, load_config, with_remat
from tflane_jax.datasets.photometric import LANESEGNET_BUCKET_PHOTOMETRIC
from tflane_jax.datasets.view_images import LANESEGNET_BUCKET
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.traffic_elements import ElementLossConfig
from tflane_jax.models.area_decoder import PAPER_AREA_DECODER
from tflane_jax.models.lanesegnet import LaneSegNetConfig, paper_bucket_config
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    return _bucket(paper_bucket_config())


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder, and that of the published area head."""
    config, model = get_config(), paper_bucket_config()
    return {
        "remat": with_remat(config),
        "bfloat16": with_remat(config, "bfloat16"),
        "published_fault": _bucket(replace(model, areas=replace(PAPER_AREA_DECODER, output="raw"))),
    }


def _bucket(model: LaneSegNetConfig) -> RunConfig:
    """Return LaneSegNet's configuration with another model, and the labels and images that it takes."""
    config = load_config(str(HERE.with_name("lanesegnet_r50.py")))
    six_layers = load_ablations(str(HERE.parent.with_name("camera") / "toponet_r50.py"))["six_layers"]
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(six_layers.task, LaneGraphTask)
    assert isinstance(config.data, OpenLaneV2Data)
    assert isinstance(config.task.losses, LaneSegNetLossConfig)
    losses = replace(config.task.losses, elements=ElementLossConfig(empty_frames="skip"))
    task = replace(config.task, model=replace(model, encoder=six_layers.task.model.encoder), losses=losses)
    example = replace(config.data.example, crossings="ring")
    data = replace(config.data, image=LANESEGNET_BUCKET, example=example, augmentation=LANESEGNET_BUCKET_PHOTOMETRIC)
    return replace(config, task=task, data=data, training=replace(config.training, best_metric="all/OLUS"))
