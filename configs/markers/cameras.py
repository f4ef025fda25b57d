"""The marker paper's Table II from camera images: markers and their ablations on the small camera TopoNet, on clips.

    tflane compare camera/toponet --seeds 0 --out runs/camera
    C=markers/cameras
    tflane compare toponet=$C:toponet uniform=$C:uniform hard=$C:hard markers=$C --seeds 0 1 2 --jobs 2 \\
        --out runs/markers/cameras

A first look, for a machine of two cores: the first command trains the host of docs/cameras.md, with TopoNet's published
forms, on single frames two seconds apart. Every row of the second starts from that one host; its seeds vary the new
parameters and the order of the clips. The paper's tables have hosts by the recipe of docs/small_models.md, on clips
half a second apart and one for each seed: `camera_clips.py`. The images show the marker boards, but too small to be
read: detections are simulated as in `toponet_markers.py` (paper, section IV-A), of boards that the rig's cameras see.
docs/marker_results.md has results of earlier rows.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.marker_fusion import SMALL_MARKER_FUSION, MarkerFusionConfig, uniform_fusion
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.roads.markers import PlacementConfig

HOST = "runs/camera/toponet/seed_0"


def get_config() -> RunConfig:
    """Return gated fusion with full memory."""
    host = load_config(str(Path(__file__).parents[1] / "camera/toponet.py"))
    assert isinstance(host.task, LaneGraphTask)
    assert isinstance(host.task.model, TopoNetConfig)
    assert isinstance(host.data, WorldData)
    assert host.data.example.cameras is not None
    world = replace(host.data.world, markers=PlacementConfig(side="both", site="clear"))
    seen = MarkerSimulationConfig(cameras=host.data.example.cameras.cameras, occlusion="bodies")
    example = replace(
        host.data.example,
        cameras=replace(host.data.example.cameras, markers=True),
        markers=MarkerConfig(simulation=seen),
    )
    # Denoising speeds up training from random weights; this decoder is trained already.
    model = replace(host.task.model, denoising=None, priors=PriorsConfig(markers=SMALL_MARKER_FUSION))
    return replace(
        host,
        task=replace(host.task, model=model, clip=4),
        data=replace(host.data, world=world, example=example),
        optim=replace(host.optim, ema_decay=0.99),
        training=replace(host.training, steps=300, batch_size=2, eval_every=300, init_from=HOST, init_partly=True),
    )


def ablations() -> dict[str, RunConfig]:
    """Return the other rows of the table, gated fusion without memory of markers, and rows without memory of BEV."""
    config = get_config()
    markers = SMALL_MARKER_FUSION

    def with_markers(changed: MarkerFusionConfig | None) -> RunConfig:
        return with_setting(config, "task.model.priors", PriorsConfig(markers=changed))

    def alone(row: RunConfig) -> RunConfig:
        """Return the row without memory of BEV features, as the host was trained."""
        return with_setting(row, "task.model.encoder.bev.memory", "off")

    return {
        "toponet_single": alone(with_markers(None)),
        "markers_single": alone(config),
        "toponet": with_markers(None),
        "uniform": with_markers(uniform_fusion(markers)),
        "ungated": with_markers(replace(markers, fusion="uniform")),
        "hard": with_markers(replace(markers, fusion="hard")),
        "no_memory": with_markers(replace(markers, memory=None)),
    }
