"""TopoNet with traffic flow on the maps of recorded logs: traffic and sensors are simulated, the roads are real.

    tflane train --config real_maps --data.maps FOLDER
    tflane train --config real_maps:mixed --data.maps FOLDER --data.test-logs LOG
    tflane eval RUN --data recorded --root FOLDER

FOLDER holds logs of Argoverse 2, scene files of nuScenes, segments of OpenLane-V2, or lanes as GeoJSON, in any depth.
A log in `test_logs` or `val_logs` is no training map. The third command tests on recorded traffic; `tflane carry-over`
does all of it, with each log left out once. No result yet; docs/real_roads.md tells what a run costs.
"""

import dataclasses

from tflane_jax.config import RealMapData, RunConfig, load_config


def get_config() -> RunConfig:
    """Return training on recorded maps alone, for as long as on the preset `city`."""
    return _on(RealMapData(), "tf_lane/toponet_tfm")


def ablations() -> dict[str, RunConfig]:
    """Return `mixed`, every second scene on generated roads; `generated`, all of them; and the three without traffic.

    `generated` has seen no recorded map: a control with the same capacities, steps and test data.
    """
    sources = {
        "mixed": RealMapData(generated=0.5),
        "generated": RealMapData(generated=1.0),
    }
    with_traffic = {name: _on(data, "tf_lane/toponet_tfm") for name, data in sources.items()}
    without = {name: _on(data, "tf_lane/toponet") for name, data in {"maps": RealMapData(), **sources}.items()}
    return with_traffic | {f"{name}_no_traffic": config for name, config in without.items()}


def _on(data: RealMapData, host: str) -> RunConfig:
    return dataclasses.replace(load_config(host), data=data)
