"""The lane models on single frames that every model of `toponet_markers.py` starts from.

    tflane compare markers/host markers/host:bevformer_detr --seeds 0 1 2 3 4 5 6 7 --jobs 2 \\
        --out runs/markers/hosts

Models, losses and optimizer are the recipe of docs/small_models.md (`tf_lane/toponet`, `tf_lane/lanesegnet`), with one
more block after the U-Net, so that markers enter the BEV features before and after its context. The examples hold
markers and an SD map, which the hosts ignore, so that models with priors use the same cached data. Boards stand at
every approach of a junction and behind it, several in a scene; the paper has one in a scene.

Eight seeds, 4,000 updates, DET_l in percent (`tflane tables markers.1`): TopoNet 30.7 ± 0.7, BEVFormer-DETR
16.9 ± 1.2.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.sd_map import SdMapConfig
from tflane_jax.world.simulate import WorldConfig

RECIPE = Path(__file__).parents[1] / "tf_lane"
# Eight frames half a second apart, as in OpenLane-V2.
WORLD = WorldConfig(duration_s=5.6, keyframes=8, markers=PlacementConfig(side="both", site="clear"))
# Boards that the cameras of the paper's dataset have in view.
SEEN = MarkerSimulationConfig(cameras=ARGOVERSE2_RING, occlusion="bodies")
# GNSS receiver: 2 m and 1 degree (standard deviations), on top of the map's own error of 1.5 m.
EXAMPLE = ExampleConfig(markers=MarkerConfig(simulation=SEEN), sd_map=SdMapConfig(translation=2.0, yaw_deg=1.0))
DATA = WorldData(train=2000, val=15, test=100, world=WORLD, example=EXAMPLE)
STEPS = 4000


def get_config() -> RunConfig:
    """Return TopoNet."""
    return with_setting(_trained("toponet.py", DATA), "task.model.encoder.dilations", (1,))


def ablations() -> dict[str, RunConfig]:
    """Return BEVFormer-DETR, the host without a graph, and LaneSegNet."""
    config = get_config()
    assert isinstance(config.task, LaneGraphTask)
    toponet, losses = config.task.model, config.task.losses
    assert isinstance(toponet, TopoNetConfig)
    assert isinstance(losses, TopoNetLossConfig)
    # Its reference points never move, so that there is no proposed lane to start from.
    decoder = replace(toponet.decoder, refine="fixed", proposals=None)
    baseline = BevFormerDetrConfig(
        encoder=toponet.encoder, range=toponet.range, decoder=decoder, elements=None, denoising=toponet.denoising
    )
    baseline_losses = BevFormerDetrLossConfig(
        points_weight=losses.points_weight, successor_weight=losses.successor_weight, class_target=losses.class_target
    )
    lanesegnet = _trained("lanesegnet.py", replace(DATA, example=replace(EXAMPLE, crossings="sides")))
    return {
        "bevformer_detr": replace(config, task=LaneGraphTask(baseline, baseline_losses)),
        "lanesegnet": with_setting(lanesegnet, "task.model.encoder", toponet.encoder),
    }


def _trained(file: str, data: WorldData) -> RunConfig:
    """Return a configuration of the recipe on our data."""
    config = load_config(str(RECIPE / file))
    training = replace(config.training, steps=STEPS, eval_every=2000)
    return replace(config, data=data, training=training, evaluation=EvaluationConfig(versions=("v2.1", "v1.0")))
