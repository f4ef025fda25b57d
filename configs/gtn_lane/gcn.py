"""LSTR with graph convolution over the eight neighbours, on front views of the built-in world.

    tflane train --config gtn_lane/gcn

Eleven minutes on one core. Test split, three seeds: accuracy 91.9 +- 0.7 percent (docs/gtn_lane.md).

Everything except the encoder is that of `transformer.py`.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.models.graph_encoders import GcnEncoderConfig


def get_config() -> RunConfig:
    """Return the baseline with this encoder."""
    baseline = load_config(str(Path(__file__).with_name("transformer.py")))
    return with_setting(baseline, "task.model.encoder", GcnEncoderConfig(dropout=0.0))
