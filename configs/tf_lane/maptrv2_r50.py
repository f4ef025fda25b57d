"""MapTRv2 at the paper's size: ResNet-50, six cameras lifted by depth, 50 and 300 lines of 20 points.

    tflane summary --config tf_lane/maptrv2_r50 --no-compile          # needs no data
    tflane train --config tf_lane/maptrv2_r50 --data.train 8 --data.val 2 --data.test 2 --training.steps 20 \\
        --optim.epoch-steps 0 --optim.warmup-steps 0 --task.model.encoder.images.frozen-stages 0

Cameras, schedule and batch are those of `maptr_r50.py`; the built-in world gives the depth of every image cell.
`:remat` recomputes activations in the backward pass, `:bfloat16` does so in half precision. `:centerlines` has the
fourth class and 70 lines. `:argoverse2` has sizes and schedule of the paper's lines with heights on Argoverse 2: seven
cameras and no depth. It reads the built-in world with that ring, not the data set.

    tflane convert --config tf_lane/maptrv2_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/maptrv2_r50:published_weights --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly
    tflane convert --config tf_lane/maptrv2_r50:published_weights --weights maptrv2_nusc_r50_24e.pth --out runs/maptrv2
    tflane eval runs/maptrv2 --data nuscenes --root PATH

`:published_weights` reads nuScenes as the published code does: in the lidar's axes, with the lift's border, and with
cameras as calibrated, without the vehicle's motion between exposure and sweep. It trains as that code does, with
photometric distortion and GridMask, but in float32, and learns depth from the lidar's sweeps of the key frames
(samples/LIDAR_TOP). For a copy of nuScenes without them: --data.depth-cell None
--task.model.encoder.bev.no-supervised.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import NuScenesData, RunConfig, WorldData, load_config, with_remat
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.geometry import BevGrid
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.lidar_axes import range_in_lidar_axes
from tflane_jax.models.maptr import PAPER_RANGE
from tflane_jax.models.maptrv2 import PAPER_LIFT_ENCODER, MapTrV2Config, paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig

MAPTR = str(Path(__file__).with_name("maptr_r50.py"))
CELL = 32
"""Pixels of a cell of the feature maps."""
AV2_SCALE = 0.3
"""Of images, relative to the cameras' own."""
AV2_EPOCH = 700 * 156 // 32
"""Steps over 700 logs of 15.6 s at 10 Hz, with 32 frames each."""


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    config = with_setting(load_config(MAPTR), "data.example.cameras.depth_cell", CELL)
    config = with_setting(config, "task.model", paper_config())
    return with_setting(config, "task.losses", MapTrV2LossConfig())


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder and of the classes, heights, and the published weights' inputs."""
    config = get_config()
    return {
        "remat": with_remat(config),
        "bfloat16": with_remat(config, "bfloat16"),
        "centerlines": _with_centerlines(config),
        "argoverse2": _with_heights(config),
        "published_weights": _published(),
    }


def _with_centerlines(config: RunConfig) -> RunConfig:
    """Return the published variant with the fourth class."""
    config = with_setting(config, "data.example.map_lines", MapLinesConfig(centerlines="include"))
    config = with_setting(config, "task.model.decoder.classes", 4)
    return with_setting(config, "task.model.decoder.queries", 70)


def _with_heights(config: RunConfig) -> RunConfig:
    """Return the published variant for Argoverse 2, on that ring of cameras in the built-in world."""
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(config.data, WorldData)
    model = config.task.model
    assert isinstance(model, MapTrV2Config)
    range_ = replace(PAPER_RANGE, z=(-5.0, 3.0))
    lift = replace(
        PAPER_LIFT_ENCODER.bev, grid=BevGrid(range_, 100, 200), cameras=7, image_scale=AV2_SCALE, supervised=False
    )
    decoder = replace(model.decoder, coordinates=3)
    model = replace(model, encoder=replace(PAPER_LIFT_ENCODER, bev=lift), range=range_, decoder=decoder)
    rig = CameraRigConfig(ARGOVERSE2_RING, scale=AV2_SCALE, multiple=CELL)
    data = replace(config.data, example=replace(config.data.example, range=range_, cameras=rig))
    optim = replace(config.optim, epoch_steps=AV2_EPOCH, warmup_steps=200)
    training = replace(config.training, steps=6 * AV2_EPOCH, eval_every=AV2_EPOCH, checkpoint_every=AV2_EPOCH)
    return replace(config, task=replace(config.task, model=model), data=data, optim=optim, training=training)


def _published() -> RunConfig:
    """Return the published weights' configuration on nuScenes."""
    config = load_config(f"{MAPTR}:published_weights")
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(config.data, NuScenesData)
    lift = PAPER_LIFT_ENCODER.bev
    grid = BevGrid(range_in_lidar_axes(lift.grid.range), 200, 100)
    lift = replace(lift, grid=grid, border="published")
    model = replace(paper_config(), encoder=replace(PAPER_LIFT_ENCODER, bev=lift), axes="lidar")
    data = replace(config.data, camera_poses="calibration", can_bus="none", depth_cell=CELL)
    task = replace(config.task, model=model, losses=MapTrV2LossConfig())
    return replace(config, task=task, data=data)
