"""Small camera hosts trained on clips of two frames: what every model of `camera_clips.py` starts from.

    tflane compare markers/camera_host markers/camera_host:bevformer_detr --seeds 0 1 2 3 4 --jobs 2 \\
        --out runs/markers/camera_hosts

Models and cameras are those of `camera/toponet.py` and `camera/bevformer_detr.py`, with those parts of the recipe of
docs/small_models.md that a camera model can have: the output in metres and the precision as class target. Those learn
from single frames; these learn with the memory of BEV features that the rows use, at the frame rate of the paper;
`alone` has none, as TopoNet's own program. One host for each seed. The examples hold markers and an SD map, which the
hosts ignore, so that all rows use the same cached data. Five seeds are trained: docs/cameras.md has their scores.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.sd_map import SdMapConfig
from tflane_jax.world.simulate import WorldConfig

CAMERA = Path(__file__).parents[1] / "camera"
# Eight frames half a second apart, four clips.
WORLD = WorldConfig(duration_s=5.6, keyframes=8, markers=PlacementConfig(side="both", site="clear"))
CLIP = 2


def get_config() -> RunConfig:
    """Return TopoNet."""
    return _on_clips("toponet")


def ablations() -> dict[str, RunConfig]:
    """Return BEVFormer-DETR, and TopoNet without memory of BEV features."""
    alone = with_setting(get_config(), "task.model.encoder.bev.memory", "off")
    return {"bevformer_detr": _on_clips("bevformer_detr"), "alone": alone}


def _on_clips(name: str) -> RunConfig:
    """Return the training of a small camera model on clips."""
    config = load_config(str(CAMERA / f"{name}.py"))
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(config.data, WorldData)
    cameras = config.data.example.cameras
    assert cameras is not None
    model, losses = config.task.model, config.task.losses
    assert isinstance(model, TopoNetConfig | BevFormerDetrConfig)
    assert isinstance(losses, TopoNetLossConfig)
    model = replace(model, decoder=replace(model.decoder, output="metric"))
    example = replace(
        config.data.example,
        cameras=replace(cameras, markers=True),
        markers=MarkerConfig(simulation=MarkerSimulationConfig(cameras=cameras.cameras, occlusion="bodies")),
        # GNSS receiver: 2 m and 1 degree (standard deviations), on top of the map's own error of 1.5 m.
        sd_map=SdMapConfig(translation=2.0, yaw_deg=1.0),
    )
    return replace(
        config,
        task=replace(config.task, model=model, losses=replace(losses, class_target="quality"), clip=CLIP),
        data=replace(config.data, world=WORLD, example=example),
        training=replace(config.training, steps=2000, batch_size=2, eval_every=1000),
        evaluation=EvaluationConfig(versions=("v2.1", "v1.0")),
    )
