"""MapTRv2 at the paper's size: ResNet-50, six cameras lifted by depth, 50 and 300 lines of 20 points.

    tflane summary --config tf_lane/maptrv2_r50 --no-compile          # needs no data
    tflane train --config tf_lane/maptrv2_r50 --data.train 8 --data.val 2 --data.test 2 --training.steps 20 \\
        --optim.epoch_steps 0 --optim.warmup_steps 0 --task.model.encoder.images.frozen-stages 0

Cameras, schedule and batch are those of `maptr_r50.py`; the built-in world gives the depth of every image cell.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.maptrv2 import paper_config
from tflane_jax.tasks.lane_graph import LaneGraphTask


def get_config() -> RunConfig:
    """Return the paper's configuration."""
    config = load_config(str(Path(__file__).with_name("maptr_r50.py")))
    assert isinstance(config.data, WorldData)
    example = config.data.example
    assert example.cameras is not None
    # Cells of the feature maps: stride 32.
    data = replace(config.data, example=replace(example, cameras=replace(example.cameras, depth_cell=32)))
    return replace(config, task=LaneGraphTask(paper_config(), MapTrV2LossConfig(rings="both")), data=data)
