"""MapTR with the traffic-flow module at the papers' sizes, on nuScenes with its own tracks (TF-Lane, Table 3).

    tflane summary --config tf_lane/maptr_tfm_r50 --no-compile          # needs no data
    tflane convert --config tf_lane/maptr_tfm_r50 --weights resnet50.pth --out runs/imagenet
    tflane train --config tf_lane/maptr_tfm_r50 --data.root PATH \\
        --training.init-from runs/imagenet --training.init-partly

Host, images, labels and recipe are those of `maptr_r50:published_weights`, module and epochs those of
`toponet_tfm_r50.py`. Past frames are the key frames before, at 2 Hz. `:remat` recomputes activations in the backward
pass, `:bfloat16` does so in half precision; `:host` is the baseline without the module.
"""

from pathlib import Path

from tflane_jax.config import RunConfig, epochs_of, load_config, with_epochs, with_priors_of, with_remat
from tflane_jax.config_io import with_setting

HERE = Path(__file__)
HOST = str(HERE.with_name("maptr_r50.py:published_weights"))
EPOCHS = epochs_of(load_config(str(HERE.with_name("toponet_tfm_r50.py"))))


def get_config() -> RunConfig:
    """Return the paper's host with the module."""
    config = with_priors_of(load_config(str(HERE.with_name("toponet_tfm_r50.py"))), load_config(HOST))
    return with_epochs(with_setting(config, "data.example.history_hz", 2.0), EPOCHS)


def ablations() -> dict[str, RunConfig]:
    """Return variants of the encoder, and the host alone."""
    rows = {"remat": with_remat(get_config()), "bfloat16": with_remat(get_config(), "bfloat16")}
    return rows | {"host": with_epochs(load_config(HOST), EPOCHS)}
