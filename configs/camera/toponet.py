"""TopoNet from six cameras of the built-in world, at a size for two cores.

    tflane train --config camera/toponet
    tflane compare camera/bevformer_detr camera/toponet --seeds 0 1 2 --out runs/camera

3,000 updates take 23 minutes on two cores. Test split, one seed, percent: OLS 23.5, DET_l 19.6, TOP_ll 7.7 of v2.1
(docs/cameras.md, trained at commit 2b2c3f75).
"""

from dataclasses import replace

from tflane_jax.config import RunConfig, WorldData
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.bev_encoder import SMALL_BEVFORMER
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.element_decoder import ElementDecoderConfig
from tflane_jax.models.image_encoder import ImageEncoderConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.cameras.ring import CameraRigConfig

# MapTR's range. At 240 x 144 pixels a lane line is less than a pixel wide at 20 m.
TRUTH = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))
GRID = BevGrid(PerceptionRange((-30.72, 30.72), (-15.36, 15.36)), rows=25, columns=50)
# A traffic element below 40 pixels of native height cannot be recognised at this scale.
RIG = CameraRigConfig(scale=0.15, multiple=16, element_pixels=40.0)
ENCODER = CameraEncoderConfig(
    # Three levels: strides 8, 16 and 32.
    ImageEncoderConfig(stages=(1, 2, 3), pyramid=FeaturePyramidConfig(64, 3)),
    # A camera sees at most 469 of the 1,250 cells.
    replace(SMALL_BEVFORMER, grid=GRID, levels=3, cameras=6, capacity=480),
    cells=True,
)
MODEL = TopoNetConfig(
    encoder=ENCODER,
    range=TRUTH,
    decoder=LaneDecoderConfig(queries=32),
    elements=ElementDecoderConfig(levels=3),
    denoising=DenoisingConfig(),
)


def get_config() -> RunConfig:
    """Return the small camera model."""
    return RunConfig(
        task=LaneGraphTask(
            MODEL,
            TopoNetLossConfig(successor_weight=20.0),
        ),
        data=WorldData(train=600, val=20, test=75, example=ExampleConfig(range=TRUTH, sensor=None, cameras=RIG)),
        optim=OptimConfig(lr=2e-3, warmup_steps=100, optimizer="muon", b2=0.99, clip_norm=5.0),
        training=TrainingConfig(steps=3000, batch_size=4, eval_every=1000, checkpoint_every=500),
    )


def ablations() -> dict[str, RunConfig]:
    """Return the model without denoising queries."""
    return {"plain": with_setting(get_config(), "task.model.denoising", None)}
