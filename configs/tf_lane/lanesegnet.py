"""LaneSegNet on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/lanesegnet
    tflane train --config tf_lane/lanesegnet:street

Same roads, encoder and optimizer as `toponet.py`, and the recipe of docs/small_models.md. Crossings are labelled by
their long sides. `:street_published` has the decoder's published forms instead.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.models.lane_queries import LaneProposalConfig
from tflane_jax.models.lane_segments import SegmentDecoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

DECODER = SegmentDecoderConfig(
    layers=2,
    queries=48,
    sampling_points=8,
    refine="iterative",
    output="metric",
    offsets="lane",
    initial_score=0.01,
    proposals=LaneProposalConfig(count=36),
)
# The mask terms' published weights, 3 each, exceed all others on a grid of a few hundred cells.
LOSSES = LaneSegNetLossConfig(class_target="quality", dice_cost="probabilities", mask_weight=1.0, dice_weight=1.0)


def get_config() -> RunConfig:
    """Return the baseline on the preset `city`."""
    return _segments("toponet.py")


def ablations() -> dict[str, RunConfig]:
    """Return the baseline on the preset `street`, and the same with LaneSegNet's published decoder and losses."""
    street = _segments("toponet.py:street")
    assert isinstance(street.task, LaneGraphTask)
    model = replace(street.task.model, decoder=SegmentDecoderConfig(layers=3, queries=48), denoising=None)
    return {
        "street": street,
        "street_published": replace(street, task=replace(street.task, model=model, losses=LaneSegNetLossConfig())),
    }


def _segments(file: str) -> RunConfig:
    """Return TopoNet's configuration with LaneSegNet in place of TopoNet."""
    config = load_config(str(Path(__file__).with_name(file)))
    assert isinstance(config.task, LaneGraphTask)
    host = config.task.model
    assert isinstance(host, TopoNetConfig)
    assert isinstance(config.data, WorldData)
    model = LaneSegNetConfig(encoder=host.encoder, range=host.range, decoder=DECODER, denoising=host.denoising)
    data = replace(config.data, example=replace(config.data.example, crossings="sides"))
    training = replace(config.training, best_metric="all/mAP")
    return replace(config, task=replace(config.task, model=model, losses=LOSSES), data=data, training=training)
