"""Masking variants of the traffic-flow module's attention, on TopoNet and the preset `street`.

    tflane train --config tf_lane/masking:window
    tflane tables tf_lane.masking --jobs 2

Everything but the masks is that of `toponet_tfm.py:street`, the paper's LT/LL with one softmax for each quadrant.

The table, 2,500 updates, three seeds: recall of hidden lanes that vehicles drove along 49.3 to 51.0 percent, LT/LL
49.6 ± 1.3; that a variant is better is not shown.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.models.traffic_flow_module import ALL_FUSIONS, LANE_FUSIONS, Fusion
from tflane_jax.models.traffic_masks import TrafficMaskConfig

FAR = 1000.0


def get_config() -> RunConfig:
    """Return the masks of the paper's best row: lanes attend to all valid instances, then to lanes (LT/LL)."""
    return load_config(str(Path(__file__).with_name("toponet_tfm.py:street")))


def ablations() -> dict[str, RunConfig]:
    """Return the variants by name; distances are between the reference of a lane query and a track."""
    return {
        "all": _masked(TrafficMaskConfig(), ALL_FUSIONS),
        "joint": _masked(TrafficMaskConfig(softmax="joint")),
        "joint_all": _masked(TrafficMaskConfig(softmax="joint"), ALL_FUSIONS),
        "heads": _masked(TrafficMaskConfig(head_windows=(4.0, 8.0, 16.0, FAR))),
        "window": _masked(TrafficMaskConfig(window=6.0)),
        "nearest": _masked(TrafficMaskConfig(nearest=4)),
        "causal": _masked(TrafficMaskConfig(temporal="causal")),
    }


def _masked(masking: TrafficMaskConfig, fusions: tuple[Fusion, ...] = LANE_FUSIONS) -> RunConfig:
    module = "task.model.priors.traffic_flow.module"
    return with_setting(with_setting(get_config(), f"{module}.masking", masking), f"{module}.fusions", fusions)
