"""Scenes in the seven cameras of Argoverse 2 at their native 2048 x 1550, to be written in OpenLane-V2's layout.

    tflane data export --config camera/native_ring --out data/world
    tflane train --config camera/toponet_r50 --data.root data/world --training.batch-size 1 \\
        --training.steps 2 --optim.epoch-steps 0 --optim.warmup-steps 0 --task.model.encoder.images.frozen-stages 0

The second command makes two updates of the paper-size model, for users without OpenLane-V2.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig
from tflane_jax.world.simulate import WorldConfig


def get_config() -> RunConfig:
    """Return two scenes of two frames in each split."""
    example = ExampleConfig(sensor=None, cameras=CameraRigConfig(ARGOVERSE2_RING, scale=1.0))
    small = load_config(str(Path(__file__).with_name("toponet.py")))
    return replace(small, data=WorldData(2, 1, 1, WorldConfig(keyframes=2), example))
