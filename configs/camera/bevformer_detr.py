"""BEVFormer-DETR, OpenLane-V2's baseline, from six cameras of the built-in world: to be compared with `toponet.py`.

    tflane train --config camera/bevformer_detr

Encoder, traffic elements, data and training are those of `toponet.py`. The decoder has no scene graph, its reference
points are not refined, and the topology comes from the last layer only.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask


def get_config() -> RunConfig:
    """Return the small baseline."""
    toponet = load_config(str(Path(__file__).with_name("toponet.py")))
    host = toponet.task.model
    assert isinstance(toponet.task, LaneGraphTask)
    assert isinstance(host, TopoNetConfig)
    decoder = replace(host.decoder, refine="fixed")
    model = BevFormerDetrConfig(
        encoder=host.encoder, range=host.range, decoder=decoder, elements=host.elements, denoising=host.denoising
    )
    losses = BevFormerDetrLossConfig(points_weight=0.025, successor_weight=20.0)
    return replace(toponet, task=LaneGraphTask(model, losses))
