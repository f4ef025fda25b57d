"""Random streams by name and step."""

import zlib

import jax
import numpy as np

from tflane_jax.training.rng import stream


def words(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def test_stream_is_the_documented_derivation():
    root = jax.random.key(3)
    expected = jax.random.fold_in(jax.random.fold_in(root, zlib.crc32(b"dropout")), 17)
    assert words(stream(root, "dropout", 17)) == words(expected)


def test_streams_differ_by_root_name_and_step():
    keys = [
        words(stream(jax.random.key(seed), name, step))
        for seed in (0, 1)
        for name in ("params", "dropout")
        for step in (0, 1, 2)
    ]
    assert len(set(keys)) == len(keys)


def test_stream_is_the_same_under_jit():
    root = jax.random.key(0)
    traced = jax.jit(lambda key, step: stream(key, "dropout", step))(root, 5)
    assert words(traced) == words(stream(root, "dropout", 5))
