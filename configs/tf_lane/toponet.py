"""TopoNet's lane branch on the built-in world: the vision-only baseline.

    tflane train --config configs/tf_lane/toponet.py

Its numbers stand beside those of `toponet_tfm.py`, in README.md.
"""

from tflane_jax.config import RunConfig


def get_config() -> RunConfig:
    """Return the baseline: all defaults."""
    return RunConfig()
