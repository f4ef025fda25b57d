"""MapTR with the traffic-flow module at the papers' sizes, on nuScenes with its own tracks (TF-Lane, Table 3).

    tflane summary --config tf_lane/maptr_tfm_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/maptr_tfm_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/maptr_tfm_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Host, images, labels and recipe are those of `maptr_r50:published_weights`, the module that of `toponet_tfm_r50.py`.
Past frames are the key frames before, at 2 Hz. `:remat` recomputes activations in the backward pass, `:bfloat16` does
so in half precision.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import NuScenesData, RunConfig, load_config, with_priors_of, with_remat

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's host with the module."""
    host = load_config(str(HERE.with_name("maptr_r50.py:published_weights")))
    config = with_priors_of(load_config(str(HERE.with_name("toponet_tfm_r50.py"))), host)
    assert isinstance(config.data, NuScenesData)
    return replace(config, data=replace(config.data, example=replace(config.data.example, history_hz=2.0)))


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder."""
    return {"remat": with_remat(get_config()), "bfloat16": with_remat(get_config(), "bfloat16")}
