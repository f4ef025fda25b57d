"""LSTR's own transformer encoder on front views of the built-in world, sized for two CPU cores: the baseline.

    tflane train --config gtn_lane/transformer
    tflane compare gtn_lane/{transformer,gtn,gcn,han} --seeds 0 1 2 --out runs/table1

Eleven minutes on one core. Test split, three seeds: accuracy 74.6 +- 13.6 percent, because two of the three
had not left the initial plateau (docs/gtn_lane.md).
"""

from tflane_jax.config import EvaluationConfig, FrontViewData, RunConfig
from tflane_jax.datasets.augmentation import AugmentationConfig
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.losses.lane_shape import LaneShapeLossConfig
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

LAYER = TransformerConfig(dropout=0.0)


def get_config() -> RunConfig:
    """Return the baseline."""
    # Half the resolution with the same number of feature cells: four times as many steps in the same time.
    model = LstrConfig(
        ResNetConfig(strides=(1, 2, 2, 1)),
        encoder=TransformerEncoderConfig(layer=LAYER),
        decoder=LAYER,
        shrink=2,
        located=True,
        cells=True,
        anchors=(0.35, 1.0),
    )
    augmentation = AugmentationConfig(geometry=0.8, rotation=0.03, crop=0.95)
    return RunConfig(
        task=LaneShapeTask(model, LaneShapeLossConfig(least_depth=0.02)),
        data=FrontViewData(train=6000, val=100, test=400, augmentation=augmentation),
        optim=OptimConfig(lr=1e-3, warmup_steps=100, weight_decay=1e-4, b2=0.99, clip_norm=5.0, ema_decay=0.99),
        training=TrainingConfig(steps=4000, batch_size=4, eval_every=1000, best_metric="all/Accuracy"),
        evaluation=EvaluationConfig(batch_size=20),
    )
