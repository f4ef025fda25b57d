"""The GTN network overfits ten real TuSimple frames: network, loss and optimizer can fit real lanes.

    tflane train --config gtn_lane/overfit --data.root TUSIMPLE
    tflane eval runs/overfit

Training starts from random weights; evaluation uses the same frames. TUSIMPLE is a folder with ten labelled frames.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import EvaluationConfig, RunConfig, TuSimpleData, load_config
from tflane_jax.training.loop import TrainingConfig


def get_config() -> RunConfig:
    """Return `gtn.py` on ten frames, all in every batch, unaugmented."""
    return dataclasses.replace(
        load_config(str(Path(__file__).with_name("gtn.py"))),
        data=TuSimpleData(Path("data/tusimple"), train="all", val="all", test="all", augmentation=None),
        training=TrainingConfig(steps=2000, batch_size=10, eval_every=500, best_metric="all/Accuracy"),
        evaluation=EvaluationConfig(batch_size=10),
    )
