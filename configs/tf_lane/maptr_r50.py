"""MapTR at the paper's size (tiny, GKT): ResNet-50, six cameras, 50 lines of 20 points, on the built-in world.

    tflane summary --config tf_lane/maptr_r50 --no-compile          # needs no data
    tflane train --config tf_lane/maptr_r50 --data.train 8 --data.val 2 --data.test 2 --training.steps 20 \\
        --optim.epoch-steps 0 --optim.warmup-steps 0 --task.model.encoder.images.frozen-stages 0

The cameras are nuScenes' ring with images of 800 x 480 pixels, as the paper has them. The reference trains 24 epochs of
28,130 frames on eight GPUs, four frames each. `:bevformer` has BEVFormer's attention to the cameras instead of the
kernel, `:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision.

    tflane convert --config tf_lane/maptr_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/maptr_r50:published_weights --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly
    tflane convert --config tf_lane/maptr_r50:published_weights --weights maptr_tiny_r50_24e.pth --out runs/maptr
    tflane eval runs/maptr --data nuscenes --root PATH

`:published_weights` reads nuScenes as the published code does, in the lidar's axes, with the vehicle's CAN bus, and
trains as it does, with photometric distortion and GridMask, but in float32.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import NuScenesData, RunConfig, WorldData, with_remat
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.nuscenes_scenes import NUSCENES_SIZES
from tflane_jax.datasets.photometric import MAPTR_PHOTOMETRIC
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B
from tflane_jax.geometry import BevGrid
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.lidar_axes import range_in_lidar_axes
from tflane_jax.models.maptr import PAPER_MAP_ENCODER, PAPER_RANGE, paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.cameras.ring import CameraRigConfig

EPOCH = 28_130 // 32


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    example = ExampleConfig(
        range=PAPER_RANGE,
        sensor=None,
        cameras=CameraRigConfig(scale=0.5, multiple=32),
        map_lines=MapLinesConfig(),
    )
    return RunConfig(
        task=LaneGraphTask(paper_config(), MapTrLossConfig(), empty_frames="skip"),
        data=WorldData(example=example),
        optim=OptimConfig(
            lr=6e-4,
            decayed="all",
            epoch_steps=EPOCH,
            ema_decay=0.0,
            lr_factors=(("encoder/images/backbone", 0.1),),
        ),
        training=TrainingConfig(
            steps=24 * EPOCH, batch_size=32, eval_every=EPOCH, checkpoint_every=EPOCH, best_metric="lines/mAP"
        ),
    )


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder, and the published weights' inputs."""
    config, encoder = get_config(), PAPER_MAP_ENCODER

    def with_encoder(encoder: CameraEncoderConfig) -> RunConfig:
        return with_setting(config, "task.model.encoder", encoder)

    return {
        "bevformer": with_encoder(replace(encoder, bev=replace(encoder.bev, attention="deformable"))),
        "remat": with_remat(config),
        "bfloat16": with_remat(config, "bfloat16"),
        "published_weights": _published(with_encoder(replace(encoder, bev=LIDAR_BEV))),
    }


# One frame at a time, on a grid with x to the right and y forward.
LIDAR_BEV = replace(
    PAPER_MAP_ENCODER.bev,
    grid=BevGrid(range_in_lidar_axes(PAPER_RANGE), 200, 100),
    align="reference",
    temporal_value="initial",
    memory="off",
    motion="can_bus",
    image_size="array",
)
NUSCENES = NuScenesData(
    Path("data/nuscenes"),
    frame="lidar",
    can_bus="reference",
    image=TOPONET_SUBSET_B,
    example=replace(NUSCENES_SIZES, range=PAPER_RANGE, sensor=None, map_lines=MapLinesConfig()),
    augmentation=MAPTR_PHOTOMETRIC,
)


def _published(config: RunConfig) -> RunConfig:
    """Return a configuration on nuScenes in the lidar's axes."""
    return with_setting(with_setting(config, "task.model.axes", "lidar"), "data", NUSCENES)
