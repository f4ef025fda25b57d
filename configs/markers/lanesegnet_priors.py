"""LaneSegNet with fiducial markers or an SD map, on clips: the settings of `toponet_markers.py` on another host.

    tflane compare markers/host:lanesegnet --seeds 0 1 2 3 4 --out runs/markers/hosts
    tflane compare markers/lanesegnet_priors:{lanesegnet,sd_map} markers/lanesegnet_priors --seeds 0 1 2 3 4 \\
        --out runs/markers/lanesegnet

Every row starts from `markers/host:lanesegnet` trained with the same seed. The rows differ only in the prior.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return LaneSegNet with markers."""
    return _tuned(load_config(str(HERE.with_name("toponet_markers.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the host without priors, and with an SD map."""
    rows = load_ablations(str(HERE.with_name("toponet_markers.py")))
    return {"lanesegnet": _tuned(rows["toponet"]), "sd_map": _tuned(rows["toponet_smerf"])}


def _tuned(row: RunConfig) -> RunConfig:
    """Return the fine-tuning of a row of `toponet_markers.py` with LaneSegNet in place of TopoNet."""
    host = load_config(f"{HERE.with_name('host.py')}:lanesegnet")
    assert isinstance(row.task, LaneGraphTask)
    assert isinstance(host.task, LaneGraphTask)
    assert isinstance(host.task.model, LaneSegNetConfig)
    model = replace(host.task.model, denoising=None, priors=row.task.model.priors)
    start = str(row.training.init_from).replace("/host/", "/lanesegnet/")
    return replace(
        row,
        task=replace(row.task, model=model, losses=host.task.losses),
        data=host.data,
        training=replace(row.training, init_from=start, best_metric=host.training.best_metric),
    )
