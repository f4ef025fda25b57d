"""A model with traffic flow, trained on the built-in world, fine-tuned on one Argoverse 2 log, evaluated on another.

    tflane train --config tf_lane/argoverse2 --training.init-from RUN --out runs/finetuned
    tflane eval runs/finetuned

RUN is a run of `toponet_tfm.py`. The two logs are expected under `data/argoverse2`, in the layout of the download;
`--data.train`, `--data.val` and `--data.test` name other folders, `--data.openlane` that of OpenLane-V2's split files,
for its frames in place of every fifth. Examples have the sizes that RUN learned with, 10 s of tracks at 2 Hz among
them; in key frames of a log's first 10 s, earlier frames are missing.
One log of 32 frames shows that the program runs on real data and says little about accuracy: docs/argoverse2.md.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import LogData, RunConfig, WorldData, load_config
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

SENSOR = Path("data/argoverse2/sensor")
TRAIN = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
TEST = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def get_config() -> RunConfig:
    """Return 100 steps from a trained model on one log.

    RUN learned with Muon and batches of 4. Here it is Adam, at a tenth of the rate of `toponet:street_adam`, and 8.
    """
    trained = load_config(str(Path(__file__).with_name("toponet_tfm.py")))
    assert isinstance(trained.data, WorldData)
    test = SENSOR / "val" / TEST
    data = LogData(
        train=SENSOR / "train" / TRAIN,
        val=test,
        test=test,
        example=trained.data.example,
    )
    return dataclasses.replace(
        trained,
        data=data,
        optim=OptimConfig(lr=1.5e-4, warmup_steps=10, ema_decay=0.98),
        training=TrainingConfig(steps=100, log_every=10, eval_every=50),
    )
