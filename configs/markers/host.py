"""TopoNet's lane branch on single frames: the host that every model of `toponet_markers.py` starts from.

    tflane compare markers/host markers/host:bevformer_detr --seeds 0 1 2 3 4 --jobs 2 \\
        --out runs/markers/hosts

The examples hold markers and an SD map, which the hosts ignore, so that models with priors use the same cached data.
"""

from dataclasses import replace

from tflane_jax.config import RunConfig, WorldData
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_segments import SegmentDecoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.sd_map import SdMapConfig
from tflane_jax.world.simulate import WorldConfig

# Eight frames half a second apart, as in OpenLane-V2.
WORLD = WorldConfig(duration_s=5.6, keyframes=8, markers=PlacementConfig(side="both", site="clear"))
# Boards that the cameras of the paper's dataset have in view.
SEEN = MarkerSimulationConfig(cameras=ARGOVERSE2_RING, occlusion="bodies")
# GNSS receiver: 2 m and 1 degree (standard deviations), on top of the map's own error of 1.5 m.
EXAMPLE = ExampleConfig(markers=MarkerConfig(simulation=SEEN), sd_map=SdMapConfig(translation=2.0, yaw_deg=1.0))


def get_config() -> RunConfig:
    """Return TopoNet."""
    return RunConfig(
        task=LaneGraphTask(TopoNetConfig(denoising=DenoisingConfig()), TopoNetLossConfig(successor_weight=20.0)),
        data=WorldData(train=1000, val=15, test=100, world=WORLD, example=EXAMPLE),
        optim=OptimConfig(lr=2e-3, warmup_steps=100, optimizer="muon", b2=0.99, clip_norm=5.0),
        training=TrainingConfig(steps=2500, batch_size=4, eval_every=2500),
        evaluation=EvaluationConfig(versions=("v2.1", "v1.0")),
    )


def ablations() -> dict[str, RunConfig]:
    """Return BEVFormer-DETR, the host without a graph, and LaneSegNet."""
    config = get_config()
    assert isinstance(config.task, LaneGraphTask)
    model = BevFormerDetrConfig(encoder=config.task.model.encoder, elements=None, denoising=DenoisingConfig())
    losses = BevFormerDetrLossConfig(points_weight=0.025, successor_weight=20.0)
    segments = LaneSegNetConfig(
        encoder=config.task.model.encoder,
        decoder=SegmentDecoderConfig(sampling_points=8, refine="iterative", offsets="lane", initial_score=0.01),
        denoising=DenoisingConfig(),
    )
    lanesegnet = LaneGraphTask(segments, LaneSegNetLossConfig(dice_cost="probabilities"))
    sides = WorldData(1000, 15, 100, WORLD, replace(EXAMPLE, crossings="sides"))
    return {
        "bevformer_detr": replace(config, task=LaneGraphTask(model, losses)),
        "lanesegnet": replace(
            config, task=lanesegnet, data=sides, training=replace(config.training, best_metric="all/mAP")
        ),
    }
