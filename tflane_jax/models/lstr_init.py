"""Initial parameters as LSTR's program draws them (docs/reference/lstr.md, Recipe).

All matrices of the transformer are Xavier-uniform, those of query, key and value as one matrix. Other linear layers and
the biases of feed-forward networks have PyTorch's default, uniform within 1 / sqrt(inputs); biases of attention are 0.
The backbone begins like that anyway (`layers.resnet`). In a graph encoder, its projections are matrices of the
transformer; the selection of edge types keeps its own initial values.
"""

from __future__ import annotations

import math
import re
import zlib
from typing import Any

import jax
from flax.traverse_util import flatten_dict, unflatten_dict

from tflane_jax.models.parameters import Params

_TRANSFORMER = re.compile(r"(encoder|decoder_\d+)/.*")
_ATTENTION = re.compile(r".*(attention|graph)/(query|key|value|output)/(kernel|bias)")
_OTHER_LINEAR = re.compile(r"(heads|input_projection|cell_head)/.*")


def lstr_init(params: Params, key: jax.Array) -> Params:
    """Return parameters of the same shapes with LSTR's initial values; each depends on the key and its name alone."""
    flat: dict[str, Any] = flatten_dict(params, sep="/")  # pyright: ignore[reportAssignmentType]
    drawn = {name: _drawn(name, leaf, flat, key) for name, leaf in flat.items()}
    return unflatten_dict(drawn, sep="/")


def _drawn(name: str, leaf: jax.Array, flat: dict[str, Any], key: jax.Array) -> jax.Array:
    parent, _, last = name.rpartition("/")
    kernel = flat.get(f"{parent}/kernel")
    if kernel is None or not (_TRANSFORMER.match(name) or _OTHER_LINEAR.match(name)):
        return leaf
    inputs, outputs = kernel.shape
    attention = _ATTENTION.fullmatch(name)
    if last == "bias" and attention:
        return leaf * 0.0
    bound = 1.0 / math.sqrt(inputs)
    if last == "kernel" and _TRANSFORMER.match(name):
        packed = attention is not None and attention[2] != "output"
        bound = math.sqrt(6.0 / (inputs + (3 if packed else 1) * outputs))
    return jax.random.uniform(jax.random.fold_in(key, zlib.crc32(name.encode())), leaf.shape, leaf.dtype, -bound, bound)
