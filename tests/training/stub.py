"""A task that trains in milliseconds, with everything a real one has: terms, dropout, statistics, a host callback."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.layers.batch_norm import STATISTICS


def _host_sum(x):
    return np.asarray(x).sum(-1, dtype=np.float32)


@dataclass(frozen=True)
class LineTask:
    """Fit y = w x + b with dropout noise, and keep a running mean of y.

    `blow_up` makes the term `explosive` infinite where x exceeds it.
    `second_layer` adds an offset of its own, so that two models differ by a module.
    """

    features: int = 3
    blow_up: float = 1e9
    second_layer: bool = False

    def init(self, key, example):
        kernel = jax.random.normal(key, (example["x"].shape[-1], self.features))
        params = {"line": {"kernel": kernel, "bias": jnp.zeros(self.features)}}
        params[STATISTICS] = {"mean": jnp.zeros(())}
        return params | ({"second": {"offset": jnp.zeros(self.features)}} if self.second_layer else {})

    def loss(self, params, batch, key):
        x = batch["x"] * jax.random.bernoulli(key, 0.9, batch["x"].shape)
        error = jax.vmap(lambda features: self._apply(params, features))(x) - batch["y"][:, None]
        total = jax.pure_callback(
            _host_sum,
            jax.ShapeDtypeStruct(x.shape[:-1], jnp.float32),
            jax.lax.stop_gradient(x),
            vmap_method="expand_dims",
        )
        fit = (error**2).mean()
        explosive = jnp.where((batch["x"] > self.blow_up).any(), jnp.inf, 0.0)
        terms = {"fit": fit, "explosive": explosive}
        return fit + explosive + 0.0 * total.mean(), terms | self._statistics(params, batch)

    def predict(self, params, example):
        return self._apply(params, example["x"])

    def _statistics(self, params, batch):
        return {STATISTICS: {"mean": 0.5 * params[STATISTICS]["mean"] + 0.5 * batch["y"].mean()}}

    def _apply(self, params, x):
        y = x @ params["line"]["kernel"] + params["line"]["bias"]
        return y + params["second"]["offset"] if self.second_layer else y


def line_arrays(examples: int = 20) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    x = rng.normal(size=(examples, 4)).astype(np.float32)
    return {"x": x, "y": (x @ [1.0, -2.0, 0.5, 3.0]).astype(np.float32)}


class LineDataset:
    """The same examples one by one; it keeps the order in which they were asked for."""

    name = "lines"

    def __init__(self) -> None:
        self.arrays, self.asked = line_arrays(), []

    def __len__(self) -> int:
        return len(self.arrays["y"])

    def example(self, index: int) -> dict[str, np.ndarray]:
        self.asked.append(index)
        return {name: values[index] for name, values in self.arrays.items()}
