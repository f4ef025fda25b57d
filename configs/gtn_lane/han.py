"""LSTR with a heterogeneous graph attention network, on front views of the built-in world.

    tflane train --config gtn_lane/han

Eleven minutes on one core. Test split, three seeds: accuracy 91.8 +- 0.5 percent (docs/gtn_lane.md).

Everything except the encoder is that of `transformer.py`. The ablation `meta_paths` has composed meta-paths beside the
single relations.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.models.graph_encoders import HanEncoderConfig


def get_config() -> RunConfig:
    """Return the baseline with this encoder."""
    return with_encoder(HanEncoderConfig(dropout=0.0))


def ablations() -> dict[str, RunConfig]:
    """Return the encoder with other meta-paths."""
    composed = HanEncoderConfig(
        dropout=0.0, relations=("near", "row", "column", "near+row", "near+column", "row+column")
    )
    return {"meta_paths": with_encoder(composed)}


def with_encoder(encoder: HanEncoderConfig) -> RunConfig:
    """Return the baseline with an encoder."""
    baseline = load_config(str(Path(__file__).with_name("transformer.py")))
    return with_setting(baseline, "task.model.encoder", encoder)
