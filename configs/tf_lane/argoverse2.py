"""A world-trained +TFM model, fine-tuned on one real Argoverse 2 log and evaluated on another.

    tflane train --config configs/tf_lane/argoverse2.py --training.init-from RUN --out runs/finetuned
    tflane eval runs/finetuned

RUN is a run of `toponet_tfm.py`; the two logs are those of $TFLANE_SHARED/data/argoverse2 (default ../shared). One log
of 32 frames shows that the program runs on real data; it says little about accuracy. Numbers: docs/argoverse2.md.
"""

import dataclasses
import os
from pathlib import Path

from tflane_jax.config import LogData, RunConfig, load_config
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

TRAIN = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
TEST = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def get_config() -> RunConfig:
    """Return 100 steps from a trained model on one log, at a tenth of the world's learning rate."""
    shared = Path(os.environ.get("TFLANE_SHARED", "../shared")) / "data"
    logs = shared / "argoverse2" / "sensor" / "val"
    data = LogData(train=logs / TRAIN, val=logs / TEST, test=logs / TEST, openlane=shared / "openlanev2")
    return dataclasses.replace(
        load_config(str(Path(__file__).with_name("toponet_tfm.py"))),
        data=data,
        optim=OptimConfig(lr=1.5e-4, warmup_steps=10, ema_decay=0.98),
        training=TrainingConfig(steps=100, log_every=10, eval_every=50),
    )
