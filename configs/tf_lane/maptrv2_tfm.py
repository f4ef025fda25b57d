"""MapTRv2 with the traffic-flow module, whose queries are points: Eq. (3) keeps them (TF-Lane, Table 4).

    tflane train --config tf_lane/maptrv2_tfm
    tflane train --config tf_lane/maptrv2_tfm:street

Same data, optimizer and host as `maptrv2.py`; the settings of the module, and the names of the rows, are those of
`toponet_tfm.py`. The ablations run on the preset `street`.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    return _with_priors_of(load_config(str(HERE.with_name("toponet_tfm.py"))), "maptrv2.py")


def ablations() -> dict[str, RunConfig]:
    """Return the rows of `toponet_tfm.py` on MapTRv2."""
    rows = load_ablations(str(HERE.with_name("toponet_tfm.py")))
    return {name: _with_priors_of(row, "maptrv2.py:street") for name, row in rows.items()}


def _with_priors_of(other: RunConfig, baseline_file: str) -> RunConfig:
    baseline = load_config(str(HERE.with_name(baseline_file)))
    assert isinstance(other.task, LaneGraphTask)
    assert isinstance(baseline.task, LaneGraphTask)
    model = replace(baseline.task.model, priors=other.task.model.priors)
    return replace(baseline, task=replace(baseline.task, model=model))
