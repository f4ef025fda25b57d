"""LSTR with the published weights (TuSimple): predict on photos, evaluate, fine-tune. Nothing here was trained by us.

    tflane predict --config gtn_lane/lstr --weights LSTR_500000.npz photo.jpg
    tflane eval --config gtn_lane/lstr --weights LSTR_500000.npz --root TUSIMPLE
    tflane train --config gtn_lane/lstr --data.root TUSIMPLE --out runs/lstr

TUSIMPLE is the folder with TuSimple's label files and `clips`. On ten of its training frames the published weights give
accuracy 0.9656, FP 0, FN 0.025, as in PyTorch. `train` follows LSTR's recipe from random weights, at its batch of 16.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, TuSimpleData
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig


def get_config() -> RunConfig:
    """Return the published network and recipe; the checkpoint's stem norm is frozen."""
    return RunConfig(
        task=LaneShapeTask(LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True))),
        data=TuSimpleData(Path("data/tusimple"), train="all", val="all", test="all"),
        optim=OptimConfig(lr=1e-4, warmup_steps=0, weight_decay=0.0, clip_norm=float("inf")),
        training=TrainingConfig(steps=500_000, batch_size=16, eval_every=5000, best_metric="all/Accuracy"),
        weights=Path("data/lstr/LSTR_500000.npz"),
    )
