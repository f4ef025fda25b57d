"""LSTR with the published weights (TuSimple): predict on photos, evaluate, fine-tune. Nothing here was trained by us.

    tflane predict --config gtn_lane/lstr --weights lstr photo.jpg
    tflane eval --config gtn_lane/lstr --weights lstr --root TUSIMPLE --split test
    tflane train --config gtn_lane/lstr --data.root TUSIMPLE --out runs/lstr
    tflane eval runs/lstr --checkpoint last --root TUSIMPLE --split test

TUSIMPLE is the folder of the dataset (docs/gtn_lane.md). On ten of its training frames the published weights give
accuracy 0.9656, FP 0, FN 0.025, as in PyTorch.

`train` follows the published recipe (docs/reference/lstr.md): from Xavier-uniform matrices, 500,000 updates of 16
images of all three label files, Adam at 1e-4 and a tenth of it after 450,000 updates, no weight decay, clipping or
averaging of parameters, augmentation of full frames with probability 10/11 (what still differs:
`datasets.augmentation`). As there, the validation frames (0531) are among the training frames, so that the best
checkpoint is chosen on them, and only the test set measures anything: evaluate the last checkpoint. The whole recipe
was not run here.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, TuSimpleData
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import DropsConfig, OptimConfig


def get_config() -> RunConfig:
    """Return the published network and recipe; the norm of the stem is frozen."""
    return RunConfig(
        task=LaneShapeTask(LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True), init="lstr")),
        data=TuSimpleData(Path("data/tusimple"), train="all", val="val", test="test"),
        optim=OptimConfig(
            lr=1e-4,
            warmup_steps=0,
            weight_decay=0.0,
            clip_norm=float("inf"),
            ema_decay=0.0,
            drops=DropsConfig(steps=(450_000,), factor=0.1),
        ),
        training=TrainingConfig(steps=500_000, batch_size=16, eval_every=5000, best_metric="all/Accuracy"),
        weights=Path("lstr"),
    )
