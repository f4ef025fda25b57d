"""The GTN paper's network at full size on TuSimple, by LSTR's published recipe or warm-started from its weights.

    tflane convert --config gtn_lane/gtn_tusimple --weights lstr --edge-weight 0.98 --out runs/gtn_from_lstr
    tflane eval runs/gtn_from_lstr --root TUSIMPLE --split test
    tflane train --config gtn_lane/gtn_tusimple:fine_tuned --data.root TUSIMPLE --training.init-from runs/gtn_from_lstr
    tflane train --config gtn_lane/gtn_tusimple --data.root TUSIMPLE --out runs/gtn_tusimple
    tflane eval runs/gtn_tusimple --checkpoint last --root TUSIMPLE --split test

With LSTR's two heads, a layer whose first hop selects `self` and whose second hop selects similarity is LSTR's encoder
layer. The converted weights therefore give LSTR's numbers before any training: on ten training frames accuracy 0.9656
(`--edge-weight 1`, the default of `convert`).

Everything except the encoder is that of `lstr.py`. Ablations: `restarts` has the paper's learning rate, Eq. (2) with
the adaptive rule; the paper names neither cycles nor rates, and their lengths are ours (five cycles, each twice as
long as the one before, where none is extended; the first has 16,129 updates). `gcn` and `han` have these encoders.
`fine_tuned` makes 20,000 updates in three such cycles; name the run to start from. `gcn_fine_tuned`, `han_fine_tuned`
and `transformer_fine_tuned` (from `lstr`) are the same with these encoders.

What is trained on: `lstr.py` and this configuration train on all files, as published, so that their best checkpoint is
chosen on trained frames. Where the rule judges, by the validation file 0531, that file is not trained on. So
`restarts` differs from this configuration in its data too; its control is this one with `--data.train train`. The
published weights have seen 0531: after a warm start from them, rule and best checkpoint judge by seen frames. Evaluate
the last checkpoint, on the test set: only that measures what the weights are worth.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import RunConfig, TuSimpleData, load_config, with_restarts
from tflane_jax.config_io import with_setting
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig

LSTR = str(Path(__file__).with_name("lstr.py"))
ENCODER = "task.model.encoder"
GTN = GtnEncoderConfig(heads=2)


def get_config() -> RunConfig:
    """Return LSTR's network and recipe with the GTN encoder."""
    return with_setting(load_config(LSTR), ENCODER, GTN)


def ablations() -> dict[str, RunConfig]:
    """Return other learning rates and other encoders."""
    lstr = load_config(LSTR)
    encoders = {"gcn": GcnEncoderConfig(), "han": HanEncoderConfig()}
    others = {name: with_setting(lstr, ENCODER, encoder) for name, encoder in encoders.items()}
    return {
        "restarts": held_out(with_restarts(get_config(), cycles=5)),
        **others,
        "fine_tuned": fine_tuned(get_config()),
        **{f"{name}_fine_tuned": fine_tuned(config) for name, config in others.items()},
        "transformer_fine_tuned": fine_tuned(lstr),
    }


def fine_tuned(config: RunConfig) -> RunConfig:
    """Return a short training with Eq. (2) and the adaptive rule."""
    training = dataclasses.replace(config.training, steps=20_000, eval_every=1_000)
    return held_out(with_restarts(dataclasses.replace(config, training=training)))


def held_out(config: RunConfig) -> RunConfig:
    """Return a training on the training files without that of validation: the adaptive rule judges by it."""
    return dataclasses.replace(config, data=TuSimpleData(Path("data/tusimple"), train="train", val="val", test="test"))
