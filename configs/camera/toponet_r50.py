"""TopoNet at the paper's size, on OpenLane-V2 subset A: ResNet-50, seven cameras, 200 x 100 BEV cells, 200 queries.

    tflane summary --config camera/toponet_r50 --no-compile          # needs no data
    tflane convert --config camera/toponet_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config camera/toponet_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

The reference trains 24 epochs of 22,477 frames on eight GPUs, one frame each, so that class losses are divided by the
lanes of a frame, and frames without traffic elements have no loss of them. It draws another frame in place of one
without lanes. Its first release trains on all logs; its configuration of subset B and later copies, as here, leave out
four whose streets differ from their map.

`:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision, `:six_layers` has six
encoder layers instead of TopoNet's three. `:published_weights` evaluates as the published code does: each frame alone,
with the numbers of its pose that the weights read (`datasets.openlane_can_bus`), and pixels of all cameras divided by
the size of the front camera's crop.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import OpenLaneV2Data, RunConfig
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.photometric import TOPONET_PHOTOMETRIC
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.losses.traffic_elements import ElementLossConfig
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER, CameraEncoderConfig
from tflane_jax.models.toponet import paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

EPOCH = 22_477 // 8
# One camera of Argoverse 2 sees at most 4,710 of the 20,000 cells. Attention for all 20,000 costs three times as much
# and gives the same output.
CAPACITY = 6000
ENCODER = replace(PAPER_CAMERA_ENCODER, bev=replace(PAPER_CAMERA_ENCODER.bev, capacity=CAPACITY))


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    losses = TopoNetLossConfig(class_mean="frame", elements=ElementLossConfig(empty_frames="skip"))
    return RunConfig(
        task=LaneGraphTask(replace(paper_config(), encoder=ENCODER), losses, empty_frames="skip"),
        data=OpenLaneV2Data(Path("data/OpenLane-V2"), augmentation=TOPONET_PHOTOMETRIC, map_changes="drop"),
        optim=OptimConfig(
            decayed="all", epoch_steps=EPOCH, ema_decay=0.0, lr_factors=(("encoder/images/backbone", 0.1),)
        ),
        training=TrainingConfig(steps=24 * EPOCH, batch_size=8, eval_every=EPOCH, checkpoint_every=EPOCH),
    )


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder, and the published weights' inputs."""
    config = get_config()

    def with_encoder(encoder: CameraEncoderConfig) -> RunConfig:
        return with_setting(config, "task.model.encoder", encoder)

    images, bev = replace(ENCODER.images, remat=True), replace(ENCODER.bev, remat=True)
    alone = replace(ENCODER, bev=replace(ENCODER.bev, memory="off", motion="can_bus", image_size="first"))
    half = replace(images, precision="bfloat16"), replace(bev, precision="bfloat16")
    return {
        "remat": with_encoder(CameraEncoderConfig(images, bev)),
        "bfloat16": with_encoder(CameraEncoderConfig(*half)),
        "six_layers": with_encoder(replace(ENCODER, bev=replace(ENCODER.bev, layers=6))),
        "published_weights": with_setting(with_encoder(alone), "data.can_bus", "reference"),
    }
