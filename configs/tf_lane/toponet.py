"""TopoNet's lane branch on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/toponet
    tflane train --config tf_lane/toponet:denoising --training.steps 2500

5,000 updates take ten minutes on one core. Test split, five seeds, percent: all/DET_l 9.4 +- 1.9,
occluded/DET_l 9.3 +- 1.8 (docs/tf_lane.md).
"""

from dataclasses import replace

from tflane_jax.config import RunConfig, WorldData
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig


def get_config() -> RunConfig:
    """Return the baseline.

    A small model trained for few steps needs a higher learning rate than TopoNet's, and a larger weight on the topology
    loss, which is a mean over all pairs of queries.
    """
    return RunConfig(
        task=LaneGraphTask(losses=TopoNetLossConfig(successor_weight=20.0)),
        data=WorldData(train=1000, val=25, test=150),
        optim=OptimConfig(lr=1.5e-3, warmup_steps=100, b2=0.99, clip_norm=5.0),
        training=TrainingConfig(steps=5000, batch_size=4, eval_every=1000, checkpoint_every=1000),
    )


def ablations() -> dict[str, RunConfig]:
    """Return faster training variants, which the paper does not use (docs/cameras.md, "Small models")."""
    plain = get_config()
    model = replace(plain.task.model, denoising=DenoisingConfig())
    muon = replace(plain, optim=replace(plain.optim, lr=2e-3, optimizer="muon"))
    return {"muon": muon, "denoising": replace(muon, task=replace(plain.task, model=model))}
