"""LaneSegNet on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/lanesegnet
    tflane train --config tf_lane/lanesegnet:street

Same roads, encoder and optimizer as `toponet.py`, and the recipe of docs/small_models.md. Crossings are labelled by
their long sides. `:street_published` has the decoder's published forms instead.

`tflane tables tf_lane.1`, 2,000 updates of `:street`, eight seeds: mAP 38.0 ± 1.2, recall of hidden lanes that vehicles
drove along 31.9 ± 0.6 percent.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.losses.areas import AreaLossConfig
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.models.area_decoder import AreaDecoderConfig
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
    """Return the baseline on the preset `street`, and variants of it.

    `street_published` has LaneSegNet's published decoder and losses, `street_areas` crossings and road boundaries as
    areas with a decoder of their own, as the map-element-bucket variant.
    """
    street = _segments("toponet.py:street")
    assert isinstance(street.task, LaneGraphTask)
    model = replace(street.task.model, decoder=SegmentDecoderConfig(layers=3, queries=48), denoising=None)
    return {
        "street": street,
        "street_published": replace(street, task=replace(street.task, model=model, losses=LaneSegNetLossConfig())),
        "street_areas": _with_areas(street),
    }


def _with_areas(config: RunConfig) -> RunConfig:
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(config.task.model, LaneSegNetConfig)
    assert isinstance(config.data, WorldData)
    areas = AreaDecoderConfig(layers=2, heads=4, anchors="spread", output="metric")
    model = replace(config.task.model, decoder=replace(DECODER, classes=1), areas=areas)
    # The world's crossings turn either way.
    losses = replace(LOSSES, areas=AreaLossConfig(rings="both", least_step=0.1, class_target="quality"))
    example = replace(config.data.example, crossings="ring", area_points=areas.points)
    data = replace(config.data, example=example)
    return replace(config, task=replace(config.task, model=model, losses=losses), data=data)


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
