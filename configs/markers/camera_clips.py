"""The marker paper's Tables I to IV from camera images: rows that start from the hosts of `camera_host.py`.

    tflane tables markers.1_cameras markers.2_cameras markers.3_cameras markers.4_cameras --jobs 2 --out runs/tables

Every row starts from the host of its own seed and makes the same number of updates on clips of four frames, half a
second apart, with or without a prior; "toponet" and "bevformer_detr" are the hosts, tuned as long. Detections are
simulated, except in "pixels": there a detector reads the boards in native images, which are searched once and kept with
the examples. docs/marker_results.md says which rows are trained.

The hosts pass BEV features from frame to frame, into which Eq. (3) has added the lanes of the boards. So a row without
memory lacks the bank of markers only, and sees what BEV features keep of an earlier board. Rows `alone_...` start from
a host that passes none.
"""

import functools
from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_ablations, load_config
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

HERE = Path(__file__)
HOSTS = "runs/markers/camera_hosts"
# With seed 0, markers are 1.1 points of DET_l above no prior at update 200, on validation data, and 3.0 at the end.
STEPS = 600
# Longer than the hosts', so that memory has something to bridge.
CLIP = 4
ROWS = ("toponet", "toponet_smerf", "uniform", "hard", "no_memory", "no_decay", "mlp", "transformer")
# Boards with a whole outline, which are found in milliseconds; partly hidden ones take a hundred times as long.
PIXELS = PixelConfig(detector=DetectorConfig(search="outlines"))


def get_config() -> RunConfig:
    """Return the paper's system: gated fusion, full memory, transformer with positional encoding."""
    return _tuned(load_config(str(HERE.with_name("toponet_markers.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the other rows."""
    rows = load_ablations(str(HERE.with_name("toponet_markers.py")))
    return {name: _tuned(rows[name]) for name in ROWS} | {
        "bevformer_detr": _tuned(rows["toponet"], "bevformer_detr"),
        "pixels": _from_pixels(get_config()),
        "alone": _tuned(load_config(str(HERE.with_name("toponet_markers.py"))), "alone"),
        **{f"alone_{name}": _tuned(rows[name], "alone") for name in ("toponet", "no_memory")},
    }


def _from_pixels(row: RunConfig) -> RunConfig:
    """Return the row with markers that a detector reads in images."""
    assert isinstance(row.data, WorldData)
    markers = row.data.example.markers
    assert markers is not None
    example = replace(row.data.example, markers=replace(markers, pixels=PIXELS))
    return replace(row, data=replace(row.data, example=example))


def _tuned(row: RunConfig, host: str = "camera_host") -> RunConfig:
    """Return the fine-tuning of a camera host with the priors of a row of `toponet_markers.py`."""
    config = _host(host)
    assert isinstance(config.task, LaneGraphTask)
    assert isinstance(row.task, LaneGraphTask)
    priors: PriorsConfig = row.task.model.priors
    # Denoising speeds up training from random weights; this decoder is trained already.
    model = replace(config.task.model, denoising=None, priors=priors)
    return replace(
        config,
        task=replace(config.task, model=model, clip=CLIP),
        # As in `toponet_markers.py`; with so few updates a shorter warm-up, and an average over the last 50.
        optim=replace(config.optim, lr=0.5 * config.optim.lr, warmup_steps=50, ema_decay=0.98),
        training=replace(
            config.training,
            steps=STEPS,
            eval_every=STEPS // 3,
            init_from=f"{HOSTS}/{host}/seed_{{seed}}",
            init_partly=True,
        ),
    )


@functools.cache
def _host(name: str) -> RunConfig:
    path = str(HERE.with_name("camera_host.py"))
    return load_config(path if name == "camera_host" else f"{path}:{name}")
