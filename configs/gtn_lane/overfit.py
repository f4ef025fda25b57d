"""The GTN network learns ten real TuSimple frames by heart: network, loss and optimiser can fit real lanes.

    tflane train --config configs/gtn_lane/overfit.py
    tflane eval runs/overfit

From random weights, evaluated on the frames that it learns, in $TFLANE_SHARED/data/tusimple (default ../shared).
"""

import dataclasses
import os
from pathlib import Path

from tflane_jax.config import EvaluationConfig, RunConfig, TuSimpleData, load_config
from tflane_jax.training.loop import TrainingConfig


def get_config() -> RunConfig:
    """Return `gtn.py` on ten frames, all in every batch, unaugmented."""
    shared = Path(os.environ.get("TFLANE_SHARED", "../shared")) / "data"
    return dataclasses.replace(
        load_config(str(Path(__file__).with_name("gtn.py"))),
        data=TuSimpleData(shared / "tusimple" / "LaneDetection", train="all", val="all", test="all", augmentation=None),
        training=TrainingConfig(steps=2000, batch_size=10, eval_every=500, best_metric="all/Accuracy"),
        evaluation=EvaluationConfig(batch_size=10),
    )
