"""The GTN paper's Table 1 on front views of the built-in world: every encoder, for 10,000 steps.

    tflane tables gtn_lane.1 --search
    tflane tables gtn_lane.1
    tflane train --config gtn_lane/table1:gtn_restarts

Networks and data are those of `transformer.py`, `gtn.py`, `gcn.py` and `han.py`, whose 4,000 steps end before every run
has left its first plateau. After 10,000 steps validation is flat (docs/gtn_lane.md). To save time, the backbone's last
stage has, in every row, one block of 64 channels instead of two of 128, which take a quarter of a step.

An ablation NAME has one cosine over the run; `NAME_restarts` has the paper's Eq. (2) instead: three cycles, each twice
as long as the one before, where none is extended; an extension of the first leaves room for two. The adaptive rule
extends or restarts them by the validation loss. The cosine ends at a thousandth of its peak, a cycle at zero; nothing
else differs between them. `gtn_selection_10` and `gtn_selection_100` have one cosine, and a learning rate for the
selection of edge types that is so many times as large.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import RunConfig, load_config, with_restarts
from tflane_jax.config_io import with_setting

FOLDER, STEPS = Path(__file__).parent, 10_000
ENCODERS = {
    "transformer": "transformer.py",
    "gtn": "gtn.py",
    "gcn": "gcn.py",
    "han": "han.py",
    "han_meta_paths": "han.py:meta_paths",
}


def get_config() -> RunConfig:
    """Return the baseline, LSTR's transformer encoder."""
    return longer("transformer.py")


def ablations() -> dict[str, RunConfig]:
    """Return every encoder with one cosine, and with Eq. (2) and the rule; GTNs with a larger rate of the selection."""
    configs = {name: longer(file) for name, file in ENCODERS.items()}
    restarts = {f"{name}_restarts": with_restarts(config) for name, config in configs.items()}
    selection = {
        f"gtn_selection_{factor}": with_setting(configs["gtn"], "optim.lr_factors", (("*/selection", float(factor)),))
        for factor in (10, 100)
    }
    return configs | restarts | selection


def longer(file: str) -> RunConfig:
    """Return a configuration of this folder with more, and faster, steps."""
    config = load_config(str(FOLDER / file))
    config = with_setting(config, "task.model.backbone.blocks", (1, 2, 2, 1))
    config = with_setting(config, "task.model.backbone.channels", (16, 32, 64, 64))
    # A restart needs four evaluations after the first quarter of a cycle; the first cycle has 1,414 steps.
    training = dataclasses.replace(config.training, steps=STEPS, eval_every=200)
    return dataclasses.replace(config, training=training)
