"""Random parameters, because a model's own initialisation takes longer to compile than most tests."""

import functools
import zlib

import jax
import jax.numpy as jnp
import numpy as np


def random_params(init, *arguments, spread=0.3):
    """Return parameters shaped like those of `init(key, *arguments)`, none of them at a special value.

    Parameters with the same name and shape in two models have the same values. `spread` is the standard
    deviation of weights.
    """
    return jax.tree.map_with_path(lambda path, leaf: _random_leaf(path, leaf, spread), _shapes(init, *arguments))


def zero_params(init, *arguments):
    """Return parameters shaped like those of `init(key, *arguments)`, all of them zero."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), _shapes(init, *arguments))


def _shapes(init, *arguments):
    """Return the shapes of what `init` returns; a model is traced once for arguments of equal shapes."""
    leaves, tree = jax.tree.flatten(arguments)
    try:
        hash((init, tree))
    except TypeError:  # a module with a list or an array among its attributes
        return jax.eval_shape(init, jax.random.key(0), *arguments)
    return _traced(init, tree, tuple(jax.typeof(leaf) for leaf in leaves))


@functools.cache
def _traced(init, tree, types):
    leaves = [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in types]
    return jax.eval_shape(init, jax.random.key(0), *jax.tree.unflatten(tree, leaves))


def _random_leaf(path, leaf, spread):
    rng = np.random.default_rng(zlib.crc32(jax.tree_util.keystr(path).encode()))
    if path[-1].key in ("scale", "var"):
        return jnp.asarray(rng.uniform(0.8, 1.2, leaf.shape), leaf.dtype)
    return jnp.asarray(rng.normal(0, 0.05 if path[-1].key == "bias" else spread, leaf.shape), leaf.dtype)
