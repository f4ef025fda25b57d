"""ImageNet weights: torchvision's ResNets as the backbone of a host's image encoder.

Only the backbone is in such a file. The run folder that `tflane convert` writes of it is one to start training from.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp

from tflane_jax.convert.lstr import RESNET
from tflane_jax.convert.renaming import (
    Converted,
    below,
    check_fits,
    check_types,
    convert,
    naming,
    size_text,
    without_wrappers,
)
from tflane_jax.convert.torch_file import read_checkpoint
from tflane_jax.errors import UserError
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.layers.resnet import ResNet, ResNetConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.host import HostConfig
from tflane_jax.models.parameters import Params

PART = "encoder/images/backbone"
"""Path of the backbone's parameters in a host's."""
_CLASSIFIER = re.compile(r"(module\.)?fc\.(weight|bias)")
_TENSOR = re.compile(r"(module\.)?(conv1|bn1|layer\d+\.\d+\.(conv\d|bn\d|downsample\.[01])|fc)\.\w+")


def is_backbone(names: Iterable[str], others: Iterable[str] = ()) -> bool:
    """Return whether tensors of these names are a torchvision ResNet, with or without its classifier.

    Args:
        names: of all tensors.
        others: names of what else there is: only what should be a tensor counts.
    """
    names = [*names, *filter(_TENSOR.fullmatch, others)]
    return "conv1.weight" in {without_wrappers(name) for name in names} and all(map(_TENSOR.fullmatch, names))


def load_backbone(path: Path, model: HostConfig, entry: str | None = None) -> tuple[Params, list[dict[str, str]]]:
    """Return the parameters and statistics of a host's backbone, and an account of the file's tensors.

    Args:
        path: a state dict of torchvision, for example that of `resnet50` (.pth, .pkl, .npz); it is never unpickled as
            Python objects, see `torch_file`.
        model: a host with cameras.
        entry: path of the weights in the file, see `torch_file.read_checkpoint`.

    Raises:
        UserError: the file cannot be read, is no such state dict, or its ResNet has other sizes than the model's.
    """
    encoder = model.encoder
    if not isinstance(encoder, CameraEncoderConfig):
        raise UserError(
            f"{path}: weights of a backbone are for models with cameras: give the model an encoder of those"
        )
    checkpoint = read_checkpoint(path, entry)
    state = checkpoint.tensors
    if not is_backbone(state, checkpoint.others):
        raise UserError(f"{path}: its tensors are not those of a torchvision ResNet (conv1.weight, layer1.0...)")
    config = encoder.images.backbone
    kept = {name: tensor for name, tensor in state.items() if not _CLASSIFIER.fullmatch(name)}
    norms = rf"{PART}/(.*/)?\w*bn\d?/.*" if config.frozen_norms else "(?!)"
    rules = below("", PART, RESNET)
    with naming(path):
        check_types(checkpoint.others, rules)
        found = convert(kept, rules, "ResNet", frozen=norms)
    check_fits(found.variables, _expected(config), path)
    table = _with_classifier(found, {name: state[name].shape for name in state.keys() - kept.keys()})
    table += checkpoint.passed_over()
    return found.variables["params"] | {STATISTICS: found.variables["batch_stats"]}, table


def _expected(config: ResNetConfig) -> dict:
    """Return the shapes of the backbone's variables, below `PART`."""
    images = jnp.zeros((1, 64, 64, 3))
    found = jax.eval_shape(lambda: ResNet(config).init(jax.random.key(0), images, train=False))
    return {name: {"encoder": {"images": {"backbone": found.get(name, {})}}} for name in ("params", "batch_stats")}


def _with_classifier(found: Converted, classifier: dict[str, tuple[int, ...]]) -> list[dict[str, str]]:
    rows = [
        {"tensor": name, "shape": size_text(shape), "becomes": "ImageNet's classifier, not needed"}
        for name, shape in sorted(classifier.items())
    ]
    return [*found.table, *rows]
