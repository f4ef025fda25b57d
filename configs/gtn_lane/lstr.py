"""LSTR with the published weights (TuSimple): predict on photos, evaluate, fine-tune. Nothing here was trained by us.

    tflane predict --config configs/gtn_lane/lstr.py photo.jpg
    tflane eval --config configs/gtn_lane/lstr.py
    tflane train --config configs/gtn_lane/lstr.py --out runs/lstr

Weights and the ten labelled frames lie in $TFLANE_SHARED/data (default ../shared). On these frames: accuracy 0.9656,
FP 0, FN 0.025, as in PyTorch. `train` follows LSTR's recipe from random weights, at its batch of 16.
"""

import os
from pathlib import Path

from tflane_jax.config import RunConfig, TuSimpleData
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig


def get_config() -> RunConfig:
    """Return the published network and recipe; the checkpoint's stem norm is frozen."""
    data = Path(os.environ.get("TFLANE_SHARED", "../shared")) / "data"
    return RunConfig(
        task=LaneShapeTask(LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True))),
        data=TuSimpleData(data / "tusimple" / "LaneDetection", train="all", val="all", test="all"),
        optim=OptimConfig(lr=1e-4, warmup_steps=0, weight_decay=0.0, clip_norm=float("inf")),
        training=TrainingConfig(steps=500_000, batch_size=16, eval_every=5000, best_metric="all/Accuracy"),
        weights=data / "lstr" / "LSTR_500000.npz",
    )
