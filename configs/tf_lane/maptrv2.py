"""MapTRv2 on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/maptrv2
    tflane train --config tf_lane/maptrv2:street

Same data, encoder and optimizer as `maptr.py`, with the decoupled decoder, the one-to-many group in place of denoising
queries, and the mask of lines in BEV. There are no cameras, so that depth and the masks in the images are absent.

`:street_published` has the decoder's published forms and losses instead, `:street_centerlines` the fourth class.
`:argoverse2` learns lines with heights, as MapTRv2 does on Argoverse 2, from the two logs of `argoverse2.py`; one log
of 32 frames shows that the program runs and says nothing about accuracy.

`tflane tables tf_lane.4`, 1,500 updates of `:street`, eight seeds: mAP 52.1 ± 1.5, recall of hidden lines that vehicles
drove along 70.5 ± 2.1 percent, with masks in BEV of three cells; they are five cells wide since.
"""

from dataclasses import fields, replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.tasks.lane_graph import LaneGraphTask

# As many lines in the second group as in the first; MapTRv2 has six times as many, and repeats lines six times.
REPEATS = 2
# Of 48 frames of `street`, those with the most lines have 9 without centerlines and 16 with them.
CENTERLINE_QUERIES = 24


def get_config() -> RunConfig:
    """Return the baseline on the preset `city`."""
    return _second_version("maptr.py")


def ablations() -> dict[str, RunConfig]:
    """Return the baseline on the preset `street`, variants of it, and heights on Argoverse 2."""
    rows = {name: _second_version(f"maptr.py:{name}") for name in ("street", "street_published")}
    return rows | {"street_centerlines": _with_centerlines(rows["street"]), "argoverse2": _with_heights()}


def _with_centerlines(config: RunConfig) -> RunConfig:
    config = with_setting(config, "data.example.map_lines.centerlines", "include")
    return _with_decoder(config, classes=4, queries=CENTERLINE_QUERIES)


def _with_heights() -> RunConfig:
    config, logs = get_config(), load_config(str(Path(__file__).with_name("argoverse2.py")))
    data = with_setting(logs.data, "example.map_lines", MapLinesConfig())
    training = replace(logs.training, best_metric=config.training.best_metric)
    config = replace(config, data=data, training=training)
    return replace(_with_decoder(config, coordinates=3, queries=48), optim=replace(config.optim, warmup_steps=10))


def _with_decoder(config: RunConfig, *, queries: int, **changes: int) -> RunConfig:
    """Return a configuration with another decoder, and as many queries in the second group as in the first."""
    for name, value in {"queries": queries, **changes}.items():
        config = with_setting(config, f"task.model.decoder.{name}", value)
    return with_setting(config, "task.model.many", queries)


def _second_version(file: str) -> RunConfig:
    """Return a configuration of MapTR with MapTRv2 in its place."""
    config = load_config(str(Path(__file__).with_name(file)))
    assert isinstance(config.task, LaneGraphTask)
    host, losses = config.task.model, config.task.losses
    assert isinstance(host, MapTrConfig)
    assert isinstance(losses, MapTrLossConfig)
    model = MapTrV2Config(
        encoder=host.encoder, range=host.range, decoder=host.decoder, many=host.decoder.queries, line_mask=True
    )
    shared = {field.name: getattr(losses, field.name) for field in fields(losses)}
    task = replace(config.task, model=model, losses=MapTrV2LossConfig(many_repeats=REPEATS, **shared))
    return replace(config, task=task)
