"""TopoNet's lane branch with the traffic-flow module (TF-Lane), and the ablations of the paper's Tables 5 and 6.

    tflane train --config tf_lane/toponet_tfm
    tflane train --config tf_lane/toponet_tfm:abla1

Same data, optimiser and host as `toponet.py`. The paper runs its ablations on LaneSegNet; here they run on TopoNet.
"""

import dataclasses
from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.traffic_flow_module import (
    ALL_FUSIONS,
    LANE_FUSIONS,
    TrafficFlowConfig,
    TrafficFlowModuleConfig,
)
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    return _with_traffic_flow(TrafficFlowConfig())


def ablations() -> dict[str, RunConfig]:
    """Return the rows of Table 5 (Pipe., Dep., Norm.) and Table 6 (N_t, tol_pts), by the paper's names."""
    architecture = {
        "abla1": (ALL_FUSIONS, 3, False),
        "abla2": (ALL_FUSIONS, 1, False),
        "abla3": (LANE_FUSIONS, 3, False),
        "abla4": (LANE_FUSIONS, 1, False),
        "abla5": (LANE_FUSIONS, 1, True),
    }
    data = {"abla6": (20, 5), "abla7": (30, 5), "abla8": (30, 10)}
    return {name: _architecture(*row) for name, row in architecture.items()} | {
        name: _data(*row) for name, row in data.items()
    }


def _architecture(fusions: tuple, depth: int, normalised: bool) -> RunConfig:
    module = TrafficFlowModuleConfig(fusions=fusions, depth=depth, position_encoding="sine" if normalised else "linear")
    prior = TrafficFlowPriorConfig(coordinates="normalised" if normalised else "metres")
    return _with_traffic_flow(TrafficFlowConfig(prior=prior, module=module))


def _data(instances: int, tolerance: int) -> RunConfig:
    prior = TrafficFlowPriorConfig(max_instances=instances, min_valid_frames=tolerance)
    return _with_traffic_flow(TrafficFlowConfig(prior=prior))


def _with_traffic_flow(traffic_flow: TrafficFlowConfig) -> RunConfig:
    baseline = load_config(str(Path(__file__).with_name("toponet.py")))
    model = dataclasses.replace(baseline.task.model, priors=PriorsConfig(traffic_flow=traffic_flow))
    return dataclasses.replace(baseline, task=dataclasses.replace(baseline.task, model=model))
