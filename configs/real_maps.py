"""TopoNet with traffic flow on the maps of recorded logs: traffic and sensors are simulated, the roads are real.

    tflane train --config real_maps --data.maps FOLDER
    tflane train --config real_maps:mixed --data.maps FOLDER --data.test-logs LOG
    tflane eval RUN --data recorded --root FOLDER

FOLDER holds logs of Argoverse 2, scene files of nuScenes, segments of OpenLane-V2, or lanes as GeoJSON, in any depth.
A log in `test_logs` or `val_logs` is no training map. The third command tests on recorded traffic; `tflane carry-over`
does all of it, with each log left out once; docs/real_roads.md tells what a run costs, and a first result.

Generated roads are those of the preset `real-like`, which was fitted to mean statistics of nine recorded logs.
"""

from dataclasses import replace

from tflane_jax.config import RealMapData, RunConfig, load_config
from tflane_jax.config_io import with_setting
from tflane_jax.models.raster_fusion import TrafficRasterConfig
from tflane_jax.world.presets import CITY, REAL_LIKE

# Recorded frames hold twice as many lanes as those of `city`, for which the host has 48 queries and 36 proposals.
QUERIES, PROPOSALS = 96, 72
MAPS = RealMapData(generated_world=REAL_LIKE)


def get_config() -> RunConfig:
    """Return training on recorded maps alone, for as long as on the preset `city`."""
    return _on(MAPS, "tf_lane/toponet_tfm")


def ablations() -> dict[str, RunConfig]:
    """Return `mixed`, every second scene on generated roads; `generated`, all of them; and the three without traffic.

    `mixed_bev` is `mixed` with the tracks written into the BEV features as well, which is ours.

    `generated` has seen no recorded map: a control with the same capacities, steps and test data. It is validated on
    the maps, so that they choose its best checkpoint: test it with `--checkpoint last`. Its own controls:
    `generated_right_hand`, where all traffic keeps to the right, and `generated_city`, on the preset `city`.
    """
    sources = {"mixed": replace(MAPS, generated=0.5), "generated": replace(MAPS, generated=1.0)}
    without = {name: _on(data, "tf_lane/toponet") for name, data in {"maps": MAPS, **sources}.items()}
    right_hand = replace(REAL_LIKE, mirrored=0.0)
    sources["generated_right_hand"] = replace(MAPS, generated=1.0, generated_world=right_hand)
    sources["generated_city"] = replace(MAPS, generated=1.0, generated_world=CITY)
    with_traffic = {name: _on(data, "tf_lane/toponet_tfm") for name, data in sources.items()}
    with_traffic["mixed_bev"] = _with_bev(with_traffic["mixed"])
    return with_traffic | {f"{name}_no_traffic": config for name, config in without.items()}


def _on(data: RealMapData, host: str) -> RunConfig:
    config = with_setting(load_config(host), "data", data)
    config = with_setting(config, "task.model.decoder.queries", QUERIES)
    return with_setting(config, "task.model.decoder.proposals.count", PROPOSALS)


def _with_bev(config: RunConfig) -> RunConfig:
    return with_setting(config, "task.model.priors.traffic_flow.bev", TrafficRasterConfig())
