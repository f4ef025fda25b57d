"""TopoNet with fiducial markers (Wu and Hu), and the other rows of the paper's Tables I to IV, on clips.

    tflane tables markers.1 --jobs 2 --cores 1

Every row starts from the host of `host.py` trained with the same seed and makes the same number of updates, with or
without a prior. The rows differ only in the prior. A clip has four frames, half a second apart.

DET_l of eight seeds of this table, percent: TopoNet 33.0 ± 0.6, with markers 40.6 ± 0.5, with SMERF 34.0 ± 0.6,
BEVFormer-DETR 19.3 ± 0.5.
"""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.config import RunConfig, load_config
from tflane_jax.models.marker_fusion import SMALL_MARKER_FUSION, MarkerFusionConfig, as_written, uniform_fusion
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.raster_fusion import MarkerRasterConfig
from tflane_jax.models.sd_map_encoder import SMALL_SD_MAP
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

MARKERS = SMALL_MARKER_FUSION
HOSTS = "runs/markers/hosts"
# A fifth of it is too short: TopoNet tuned without a prior is then worse than the host it started from.
STEPS = 2000


def get_config() -> RunConfig:
    """Return the paper's system: gated fusion, full memory, transformer with positional encoding."""
    return _tuned(markers=MARKERS)


def ablations() -> dict[str, RunConfig]:
    """Return the other rows of each table, and variants beyond the paper.

    "uniform" trusts all markers alike (`uniform_fusion`); rows that end in "as_written" are Eq. (3) to the letter, and
    "as_written_near" is that with a radius. Of the variants, "ungated" only sets c = 1 in Eq. (3), and "everywhere" has
    no radius.
    """
    memory = MARKERS.memory
    assert memory is not None
    table_1 = {
        "bevformer_detr": _tuned("bevformer_detr"),
        "toponet": _tuned(),
        "toponet_smerf": _tuned(sd_map=SMALL_SD_MAP),
    }
    rows = _tables_2_to_4(MARKERS) | {
        "ungated": _tuned(markers=replace(MARKERS, fusion="uniform")),
        "everywhere": _tuned(markers=replace(MARKERS, radius=None)),
        "not_moved": _tuned(markers=replace(MARKERS, memory=replace(memory, compensation="none"))),
        "scaled_twice": _tuned(markers=replace(MARKERS, memory=replace(memory, gate="strongest"))),
    }
    written = as_written(MARKERS)
    rows["as_written"] = _tuned(markers=written)
    rows["as_written_near"] = _tuned(markers=replace(written, radius=MARKERS.radius))
    rows |= {f"{name}_as_written": row for name, row in _tables_2_to_4(written).items()}
    beyond = {
        "cells": _tuned(markers=replace(MARKERS, bev=MarkerRasterConfig())),
        "connectivity": _tuned(markers=replace(MARKERS, connectivity=True)),
        "everything": _tuned(markers=MARKERS, sd_map=SMALL_SD_MAP, traffic_flow=TrafficFlowConfig()),
    }
    return table_1 | rows | beyond


def _tables_2_to_4(base: MarkerFusionConfig) -> dict[str, RunConfig]:
    """Return the rows of Tables II to IV beside a form of the paper's system."""
    memory = base.memory
    assert memory is not None
    changed = {
        "uniform": uniform_fusion(base),
        "hard": replace(base, fusion="hard"),
        "no_memory": replace(base, memory=None),
        "no_decay": replace(base, memory=replace(memory, decay=1.0)),
        "mlp": replace(base, encoding="mlp"),
        "transformer": replace(base, encoding="transformer"),
    }
    return {name: _tuned(markers=markers) for name, markers in changed.items()}


def _tuned(host: str = "host", **priors: Any) -> RunConfig:
    """Return the fine-tuning of a host with priors."""
    config = _host(host)
    assert isinstance(config.task, LaneGraphTask)
    # Denoising speeds up training from random weights; this decoder is trained already.
    model = replace(config.task.model, denoising=None, priors=PriorsConfig(**priors))
    return replace(
        config,
        task=replace(config.task, model=model, clip=4),
        # Half the host's rate: most parameters are trained already. Average over about the last 100 updates.
        optim=replace(config.optim, lr=0.5 * config.optim.lr, ema_decay=0.99),
        training=replace(
            config.training,
            steps=STEPS,
            batch_size=2,
            eval_every=STEPS,
            checkpoint_every=STEPS,
            init_from=f"{HOSTS}/{host}/seed_{{seed}}",
            init_partly=True,
        ),
    )


@functools.cache
def _host(name: str) -> RunConfig:
    path = str(Path(__file__).with_name("host.py"))
    return load_config(path if name == "host" else f"{path}:{name}")
