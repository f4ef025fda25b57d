"""Parameters of a model as one tree: learned parameters and running statistics."""

from __future__ import annotations

import math
import re
import zlib
from typing import Any

import jax
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import PRNGKeyArray

from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.layers.initial import uniform_by_fan_in

Params = dict[str, Any]
"""Variables of a model. The optional entry `STATISTICS` holds the running statistics of batch norms, which have no
gradient and are not passed to the optimizer."""


def split_statistics(params: Params) -> tuple[Params, Params]:
    """Return the learned parameters, and the statistics as a tree with the entry `STATISTICS` or no entry."""
    learned = {name: value for name, value in params.items() if name != STATISTICS}
    return learned, {name: value for name, value in params.items() if name == STATISTICS}


def first_misfit(params: Params, expected: Params) -> str | None:
    """Return how the first parameter that differs from the expected shapes does so; None where all fit."""
    found, wanted = (
        {"/".join(str(key.key) for key in path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (params, expected)
    )
    for name in sorted(found.keys() | wanted.keys()):
        here, there = (_shape(tree.get(name)) for tree in (found, wanted))
        if here != there:
            return f"{name} is {here}, and {there} in the model of its configuration"
    return None


def _shape(leaf: Any) -> str:
    return "missing" if leaf is None else f"{leaf.dtype}{list(leaf.shape)}"


def with_equal_heads(variables: Any, layers: int, part: str | None = None) -> Any:
    """Return initial variables in which the heads of all decoder layers, `heads_{i}`, are those of the first layer.

    Args:
        variables: as from `Module.init`; unchanged if they hold no such heads.
        layers: of the decoder.
        part: submodule that is the decoder; None: the host itself.
    """
    params = dict(variables["params"])
    found = params if part is None else params.get(part, {})
    if "heads_0" not in found:
        return variables
    equal = {**found, **{f"heads_{i}": found["heads_0"] for i in range(layers)}}
    return {**variables, "params": equal if part is None else params | {part: equal}}


# Kernels of the layers of a host's decoders, also of its parts; not of its encoder. Where and how much to sample starts
# at zero.
_LAYERS = re.compile(
    r"((areas|elements)/)?(layer|encoder|decoder)_\d+/(?!.*(sampling_offsets|attention_weights)/).*kernel"
)
_PACKED = re.compile(r".*/(query|key|value)/kernel")


def with_xavier_layers(variables: Any, key: PRNGKeyArray) -> Any:
    """Return initial variables in which the kernels of the decoders' transformer layers are Xavier-uniform.

    PyTorch keeps the projections to queries, keys and values in one matrix, whose bound is smaller. The matrices of
    TopoNet's scene graph, one for each class of traffic elements, are one array (classes, inputs, outputs), which
    PyTorch takes for a convolution's kernel: its bound is smaller, too.
    """

    def drawn(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if not _LAYERS.fullmatch(name):
            return leaf
        *classes, inputs, outputs = leaf.shape
        if classes:
            fans = (inputs + math.prod(classes)) * outputs
        else:
            fans = inputs + (3 if _PACKED.fullmatch(name) else 1) * outputs
        limit = math.sqrt(6.0 / fans)
        return jax.random.uniform(
            jax.random.fold_in(key, zlib.crc32(name.encode())), leaf.shape, leaf.dtype, -limit, limit
        )

    return {**variables, "params": jax.tree_util.tree_map_with_path(drawn, variables["params"])}


# Biases of linear layers and convolutions that no module of the published code sets to zero: those of attention are not
# among them. In the depth network these are all that stand beside a kernel.
_BIASES = re.compile(
    r"""(
        ((areas|elements)/)?(layer|encoder|decoder)_\d+/(feed_forward|scene_graph)/(expand|contract|downsample)
        | encoder/(.+/)?layer_\d+/(expand|contract)
        | encoder/(.+/)?motion/(hidden|out)
        | encoder/(.+/)?depth_net/.+
    )/bias""",
    re.VERBOSE,
)


def with_torch_biases(variables: Any, key: PRNGKeyArray) -> Any:
    """Return initial variables in which biases that the published code leaves alone start as in PyTorch.

    They are uniform within 1 / sqrt(inputs): those of the feed-forward networks in encoder and decoders, of the layers
    that read the vehicle's motion, and of the depth network. The published encoder means those of the motion's layers
    to be zero, but asks it of a `Sequential`, which has no bias of its own.
    """
    params: dict[str, Any] = flatten_dict(variables["params"], sep="/")
    for name, leaf in params.items():
        kernel = params.get(f"{name.rpartition('/')[0]}/kernel")
        if kernel is None or not _BIASES.fullmatch(name):
            continue
        of_leaf = jax.random.fold_in(key, zlib.crc32(name.encode()))
        params[name] = uniform_by_fan_in(math.prod(kernel.shape[:-1]))(of_leaf, leaf.shape, leaf.dtype)
    return {**variables, "params": unflatten_dict(params, sep="/")}


# Heads of TopoNet and BEVFormer-DETR, relationship heads of all hosts, and the heads of traffic elements, without what
# starts at a constant: the focal class biases and the last layer of a box. Other heads draw PyTorch's values themselves
# (`lane_segments.Branch`).
_HEADS = re.compile(
    r"""(
        (?P<lane>heads_\d+)/(class_\d+/(kernel|bias) | class_out/kernel | points/linear_\d+/(kernel|bias))
        | element_embedding_\d+/(expand|contract)/(kernel|bias)
        | (heads_\d+/)?(successor|element_lane)/.+/(kernel|bias)
        | elements/(class_\d+/kernel | box_\d+/hidden/linear_\d+/(kernel|bias))
    )""",
    re.VERBOSE,
)
_OF_LAYER = re.compile(r"^(heads|element_embedding|elements/class|elements/box)_\d+/")


def with_torch_heads(variables: Any, key: PRNGKeyArray) -> Any:
    """Return initial variables in which linear layers of the heads start as in PyTorch, equal in all decoder layers.

    Kernels and biases are uniform within 1 / sqrt(inputs). The published code makes the heads of all layers, and the
    embeddings of traffic elements, by copies of one.
    """
    params: dict[str, Any] = flatten_dict(variables["params"], sep="/")
    for name, leaf in params.items():
        found = _HEADS.fullmatch(name)
        if found is None or (found["lane"] and f"{found['lane']}/class_out/kernel" not in params):
            continue
        module = name.rpartition("/")[0]
        # The first layer for pairs reads both partners; its kernel is two parameters here.
        inputs = params[f"{module}/kernel"].shape[0] * (2 if module.endswith(("pair_first", "pair_second")) else 1)
        of_all_layers = jax.random.fold_in(key, zlib.crc32(_OF_LAYER.sub(r"\1/", name).encode()))
        params[name] = uniform_by_fan_in(inputs)(of_all_layers, leaf.shape, leaf.dtype)
    return {**variables, "params": unflatten_dict(params, sep="/")}


def joined_statistics(variables: Any) -> Params:
    """Return the variables from `Module.init` as one tree of parameters."""
    return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}
