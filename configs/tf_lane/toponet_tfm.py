"""TopoNet's lane branch with the traffic-flow module (TF-Lane), and the ablations of the paper's Tables 5 and 6.

    tflane train --config tf_lane/toponet_tfm
    tflane train --config tf_lane/toponet_tfm:street

Same data, optimizer and host as `toponet.py`: the preset `city`, and for all ablations `street`. The paper runs its
ablations on LaneSegNet (`lanesegnet_tfm.py`); here they run on TopoNet.

`tflane tables tf_lane.2`, 2,500 updates, eight seeds, recall of hidden lanes that vehicles drove along, percent:
`:street` 50.3 ± 1.0 (control 49.8 ± 1.1), `:street_bev` 57.3 ± 1.0 (control 49.8 ± 0.8).
"""

import dataclasses
from pathlib import Path
from typing import Literal

from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.raster_fusion import TrafficRasterConfig
from tflane_jax.models.traffic_flow_module import (
    ALL_FUSIONS,
    LANE_FUSIONS,
    Fusion,
    TrafficFlowConfig,
    TrafficFlowModuleConfig,
)
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    return _with_traffic_flow(TrafficFlowConfig(), "toponet.py")


def ablations() -> dict[str, RunConfig]:
    """Return `street`, the rows of Table 5 (Pipe., Dep., Norm.) and Table 6 (N_t, tol_pts), by the paper's names.

    `street_bev` also writes traffic into the BEV features, which is ours. `street_control` and `street_bev_control` are
    the same models trained without traffic: controls with equal parameters.
    Rows with a suffix take a reading that the paper leaves open, see docs/tf_lane.md: "spatial" reads "Dep." as layers
    of the spatial encoder; "sine" and "linear" exchange the encoding and keep "Norm."; "no_residual" and "mean" are
    abla5 without residual in the fusion modules, and without first and last frame beside the mean.
    """
    deep, deep_spatial = TrafficFlowModuleConfig(depth=3), TrafficFlowModuleConfig(spatial_depth=3)
    plain = TrafficFlowModuleConfig()
    architecture = {
        "abla1": _architecture(ALL_FUSIONS, deep, "linear", "metres"),
        "abla1_spatial": _architecture(ALL_FUSIONS, deep_spatial, "linear", "metres"),
        "abla2": _architecture(ALL_FUSIONS, plain, "linear", "metres"),
        "abla3": _architecture(LANE_FUSIONS, deep, "linear", "metres"),
        "abla3_spatial": _architecture(LANE_FUSIONS, deep_spatial, "linear", "metres"),
        "abla4": _architecture(LANE_FUSIONS, plain, "linear", "metres"),
        "abla4_sine": _architecture(LANE_FUSIONS, plain, "sine", "metres"),
        "abla5": _architecture(LANE_FUSIONS, plain, "sine", "normalised"),
        "abla5_linear": _architecture(LANE_FUSIONS, plain, "linear", "normalised"),
        "abla5_no_residual": _architecture(
            LANE_FUSIONS, dataclasses.replace(plain, residual="none"), "sine", "normalised"
        ),
        "abla5_mean": _architecture(LANE_FUSIONS, dataclasses.replace(plain, token="mean"), "sine", "normalised"),
    }
    paper, bev = TrafficFlowConfig(), TrafficFlowConfig(bev=TrafficRasterConfig())
    no_traffic = TrafficFlowPriorConfig(top_instances=0)
    street = {
        "street": paper,
        "street_control": dataclasses.replace(paper, prior=no_traffic),
        "street_bev": bev,
        "street_bev_control": dataclasses.replace(bev, prior=no_traffic),
    }
    data = {"abla6": (20, 5), "abla7": (30, 5), "abla8": (30, 10)}
    own = {name: _with_traffic_flow(traffic_flow) for name, traffic_flow in street.items()}
    return own | architecture | {name: _data(*row) for name, row in data.items()}


def _architecture(
    fusions: tuple[Fusion, ...],
    module: TrafficFlowModuleConfig,
    encoding: Literal["sine", "linear"],
    coordinates: Literal["normalised", "metres"],
) -> RunConfig:
    module = dataclasses.replace(module, fusions=fusions, position_encoding=encoding)
    return _with_traffic_flow(TrafficFlowConfig(TrafficFlowPriorConfig(coordinates=coordinates), module))


def _data(instances: int, tolerance: int) -> RunConfig:
    prior = TrafficFlowPriorConfig(max_instances=instances, min_valid_frames=tolerance)
    return _with_traffic_flow(TrafficFlowConfig(prior=prior))


def _with_traffic_flow(traffic_flow: TrafficFlowConfig, baseline_file: str = "toponet.py:street") -> RunConfig:
    baseline = load_config(str(Path(__file__).with_name(baseline_file)))
    return with_setting(baseline, "task.model.priors", PriorsConfig(traffic_flow=traffic_flow))
