"""LSTR's published network, warm-started and fine-tuned on front views of the built-in world, with every encoder.

    tflane tables gtn_lane.2 --search
    tflane tables gtn_lane.2

Both first convert LSTR's published weights to runs/from_lstr/ENCODER (`--weights lstr`, docs/gtn_lane.md), for the GTN
with an edge weight of 0.98.

Networks are those of `lstr.py` and `gtn_tusimple.py` at full size: LSTR's parameters have no other form. The
transformer starts as LSTR, the GTN as almost LSTR, GCN and HAN with what has a place in them (docs/gtn_lane.md). An
ablation NAME has one cosine over the run, `NAME_restarts` Eq. (2) with the adaptive rule, three cycles as in
`table1.py`. `gtn_selection_10` and `gtn_selection_100` have one cosine, and a learning rate for the selection of edge
types that is so many times as large. On TuSimple's own frames, which are not at hand in full, the same is
`gtn_tusimple:fine_tuned`, `:gcn_fine_tuned` and so on.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import EvaluationConfig, FrontViewData, RunConfig, load_config, with_restarts
from tflane_jax.config_io import with_setting
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import TransformerEncoderConfig
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

STEPS = 2_000
ENCODERS = {
    "transformer": TransformerEncoderConfig(),
    "gtn": GtnEncoderConfig(heads=2),
    "gcn": GcnEncoderConfig(),
    "han": HanEncoderConfig(),
}


def get_config() -> RunConfig:
    """Return LSTR itself, fine-tuned with one cosine."""
    published = load_config(str(Path(__file__).with_name("lstr.py")))
    return dataclasses.replace(
        published,
        data=FrontViewData(train=6000, val=100, test=400),
        optim=OptimConfig(lr=1e-4, warmup_steps=100, weight_decay=0.0, clip_norm=5.0, ema_decay=0.99),
        # A restart needs four evaluations after the first quarter of a cycle; the first cycle has 271 steps.
        training=TrainingConfig(steps=STEPS, batch_size=4, eval_every=50, best_metric="all/Accuracy"),
        evaluation=EvaluationConfig(batch_size=20),
    )


def ablations() -> dict[str, RunConfig]:
    """Return every encoder with one cosine, and with Eq. (2) and the rule; GTNs with a larger rate of the selection."""
    lstr = get_config()
    configs = {name: with_setting(lstr, "task.model.encoder", encoder) for name, encoder in ENCODERS.items()}
    restarts = {f"{name}_restarts": with_restarts(config) for name, config in configs.items()}
    selection = {
        f"gtn_selection_{factor}": with_setting(configs["gtn"], "optim.lr_factors", (("*/selection", float(factor)),))
        for factor in (10, 100)
    }
    return configs | restarts | selection
