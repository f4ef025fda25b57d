"""TopoNet with fiducial markers (Wu and Hu), and the other rows of the paper's Tables I to IV, on clips.

    tflane compare markers/host markers/host:bevformer_detr --seeds 0 1 2 3 4 \\
        --out runs/markers/hosts
    tflane compare markers/toponet_markers:{toponet,bevformer_detr,toponet_smerf} \\
        markers/toponet_markers --seeds 0 1 2 3 4 --out runs/markers/table_1

Every row starts from the host of `host.py` trained with the same seed and makes the same number of updates, with or
without a prior. The rows differ only in the prior. A clip has four frames, half a second apart.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.config import RunConfig, load_config
from tflane_jax.models.marker_fusion import SMALL_MARKER_FUSION
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SMALL_SD_MAP
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

MARKERS = SMALL_MARKER_FUSION
HOSTS = "runs/markers/hosts"


def get_config() -> RunConfig:
    """Return the paper's system: gated fusion, full memory, transformer with positional encoding."""
    return _tuned(markers=MARKERS)


def ablations() -> dict[str, RunConfig]:
    """Return the other rows of each table, and two variants beyond the paper."""
    memory = MARKERS.memory
    assert memory is not None
    table_1 = {
        "bevformer_detr": _tuned("bevformer_detr"),
        "toponet": _tuned(),
        "toponet_smerf": _tuned(sd_map=SMALL_SD_MAP),
    }
    table_2 = {name: _tuned(markers=replace(MARKERS, fusion=name)) for name in ("uniform", "hard")}
    table_3 = {
        "no_memory": _tuned(markers=replace(MARKERS, memory=None)),
        "no_decay": _tuned(markers=replace(MARKERS, memory=replace(memory, decay=1.0))),
        "not_moved": _tuned(markers=replace(MARKERS, memory=replace(memory, compensation="none"))),
    }
    table_4 = {name: _tuned(markers=replace(MARKERS, encoding=name)) for name in ("mlp", "transformer")}
    beyond = {
        "connectivity": _tuned(markers=replace(MARKERS, connectivity=True)),
        "everything": _tuned(markers=MARKERS, sd_map=SMALL_SD_MAP, traffic_flow=TrafficFlowConfig()),
    }
    return table_1 | table_2 | table_3 | table_4 | beyond


def _tuned(host: str = "host", **priors: Any) -> RunConfig:
    """Return the fine-tuning of a host with priors."""
    path = str(Path(__file__).with_name("host.py"))
    config = load_config(path if host == "host" else f"{path}:{host}")
    assert isinstance(config.task, LaneGraphTask)
    # Denoising speeds up training from random weights; this decoder is trained already.
    model = replace(config.task.model, denoising=None, priors=PriorsConfig(**priors))
    return replace(
        config,
        task=replace(config.task, model=model, clip=4),
        # Average over about the last 100 updates: over 1,000, the host's own weights would dominate it.
        optim=replace(config.optim, ema_decay=0.99),
        training=replace(
            config.training,
            steps=400,
            batch_size=2,
            eval_every=400,
            init_from=f"{HOSTS}/{host}/seed_{{seed}}",
            init_partly=True,
        ),
    )
