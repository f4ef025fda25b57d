"""MapTR on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/maptr
    tflane train --config tf_lane/maptr:street

Same roads, encoder and optimizer as `toponet.py`, and the parts of the recipe of docs/small_models.md that a decoder of
points can have. `:street_published` has the decoder's published forms and losses instead.

`tflane tables tf_lane.3`, 2,000 updates of `:street`, eight seeds: mAP 59.5 ± 1.7, recall of hidden lines that vehicles
drove along 76.3 ± 2.0 percent.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

# Of 60 frames, those of `street` have 5 lines in the mean and 10 at most, those of `city` 10 and 21. The time of an
# update grows with the square of queries times points, and with the heads.
DECODER = LineDecoderConfig(layers=2, queries=16, points=20, heads=4, anchors="spread", output="metric")
CITY_QUERIES = 28
LOSSES = MapTrLossConfig(class_target="quality", least_step=0.1)


def get_config() -> RunConfig:
    """Return the baseline on the preset `city`."""
    return with_setting(_map_lines("toponet.py"), "task.model.decoder.queries", CITY_QUERIES)


def ablations() -> dict[str, RunConfig]:
    """Return the baseline on the preset `street`, and the same with MapTR's published decoder and losses."""
    street = _map_lines("toponet.py:street")
    assert isinstance(street.task, LaneGraphTask)
    decoder = LineDecoderConfig(queries=DECODER.queries, points=DECODER.points)
    model = replace(street.task.model, decoder=decoder, denoising=None)
    return {
        "street": street,
        "street_published": replace(street, task=replace(street.task, model=model, losses=MapTrLossConfig())),
    }


def _map_lines(file: str) -> RunConfig:
    """Return TopoNet's configuration with MapTR in place of TopoNet."""
    config = load_config(str(Path(__file__).with_name(file)))
    assert isinstance(config.task, LaneGraphTask)
    host = config.task.model
    assert isinstance(host, TopoNetConfig)
    assert isinstance(config.data, WorldData)
    model = MapTrConfig(encoder=host.encoder, range=host.range, decoder=DECODER, denoising=host.denoising)
    lines = MapLinesConfig(lines=32, points=DECODER.points)
    data = replace(config.data, example=replace(config.data.example, map_lines=lines))
    training = replace(config.training, best_metric="lines/mAP")
    return replace(config, task=replace(config.task, model=model, losses=LOSSES), data=data, training=training)
