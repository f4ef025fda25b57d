"""MapTRv2 on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/maptrv2
    tflane train --config tf_lane/maptrv2:street

Same data, encoder and optimizer as `maptr.py`, with the decoupled decoder, the one-to-many group in place of denoising
queries, and the mask of lines in BEV. There are no cameras, so that depth and the masks in the images are absent.
`:street_published` has the decoder's published forms and losses instead.
"""

from dataclasses import fields, replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.tasks.lane_graph import LaneGraphTask

# As many lines in the second group as in the first; MapTRv2 has six times as many, and repeats lines six times.
REPEATS = 2


def get_config() -> RunConfig:
    """Return the baseline on the preset `city`."""
    return _second_version("maptr.py")


def ablations() -> dict[str, RunConfig]:
    """Return the baseline on the preset `street`, and the same with the published decoder and losses."""
    return {name: _second_version(f"maptr.py:{name}") for name in ("street", "street_published")}


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
