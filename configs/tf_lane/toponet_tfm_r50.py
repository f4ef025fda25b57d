"""TopoNet with the traffic-flow module at the papers' sizes, on OpenLane-V2 subset A with the tracks of Argoverse 2.

    tflane summary --config tf_lane/toponet_tfm_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/toponet_tfm_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/toponet_tfm_r50 --data.root PATH --data.tracks PATH \\
        --training.init-from runs/imagenet --training.init-partly

Host, recipe and memory are those of `camera/toponet_r50`, with the same ablations `:remat`, `:bfloat16`, `:six_layers`
and `:published_weights`, but for 60 epochs as TF-Lane trains all models; `:host` is the baseline without the module.
Past frames come at 2 Hz, as key frames do. TF-Lane does not give the sizes of its module: it is as wide as the host
here. It trains on 16 devices and gives no batch; here it is the host's.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config, with_epochs
from tflane_jax.config_io import with_setting
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig

HOST = str(Path(__file__).parent.with_name("camera") / "toponet_r50.py")
EPOCHS = 60
TRAFFIC_FLOW = TrafficFlowConfig(module=TrafficFlowModuleConfig(width=256, heads=8))


def get_config() -> RunConfig:
    """Return the paper's host with the module."""
    return _with_traffic_flow(load_config(HOST))


def ablations() -> dict[str, RunConfig]:
    """Return the variants of the host, and the host alone."""
    rows = {name: _with_traffic_flow(row) for name, row in load_ablations(HOST).items()}
    return rows | {"host": with_epochs(load_config(HOST), EPOCHS)}


def _with_traffic_flow(config: RunConfig) -> RunConfig:
    """Return a configuration on OpenLane-V2 with traffic flow."""
    config = with_setting(config, "task.model.priors", PriorsConfig(traffic_flow=TRAFFIC_FLOW))
    config = with_setting(config, "data.tracks", Path("data/argoverse2"))
    config = with_setting(config, "data.example.tracks", 128)
    return with_epochs(with_setting(config, "data.example.history_hz", 2.0), EPOCHS)
