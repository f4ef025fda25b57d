"""A tracker that reports the truth."""

import numpy as np

from tflane_jax.world.traffic.tracker import TrackerConfig

PERFECT = TrackerConfig(
    range=np.inf,
    falloff=0.0,
    view_needed=0.0,
    drop=0.0,
    position_noise=0.0,
    position_noise_growth=0.0,
    yaw_noise=0.0,
    size_noise=0.0,
    velocity_noise=0.0,
    coast=0,
    switch_rate=0.0,
)
