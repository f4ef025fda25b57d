"""Batch normalisation as PyTorch does it: running variances are unbiased, the normalisation itself is not."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

STATISTICS = "batch_stats"
BATCH_AXIS = "batch"


class BatchNorm(nn.Module):
    """Normalise channels by the mean and variance over positions and, under `vmap`, over the named batch axis.

    The collection `batch_stats` holds the running mean and variance, which inference uses (all examples of a batch
    get the same update). Where there is no axis of the given name, the statistics are those of the one example.

    Attributes:
        frozen: constant: scale and bias lie in `batch_stats` too, and training uses the running statistics (hosts with
            a pretrained backbone; the stem of the published LSTR).
        axis_name: of the batch axis.
        momentum: weight of the new statistics in the running ones (PyTorch's sense).
        epsilon: added to the variance.
    """

    frozen: bool = False
    axis_name: str = BATCH_AXIS
    momentum: float = 0.1
    epsilon: float = 1e-5

    @nn.compact
    def __call__(
        self, x: Float[Array, "*b c"], *, train: bool, valid: Bool[Array, " v"] | None = None
    ) -> Float[Array, "*b c"]:
        """Return the normalised features.

        Args:
            x: features; the padding must be finite.
            train: use the batch's own statistics, and update the running ones.
            valid: which entries of the first axis count in the statistics (of a stack of views, those whose camera
                exists). If none does in the whole batch, the running statistics stay.
        """
        channels = x.shape[-1]
        mean = self.variable(STATISTICS, "mean", jnp.zeros, channels, jnp.float32)
        variance = self.variable(STATISTICS, "var", jnp.ones, channels, jnp.float32)
        if self.frozen:
            scale = self.variable(STATISTICS, "scale", jnp.ones, channels, jnp.float32).value
            bias = self.variable(STATISTICS, "bias", jnp.zeros, channels, jnp.float32).value
        else:
            scale = self.param("scale", nn.initializers.ones, (channels,), jnp.float32)
            bias = self.param("bias", nn.initializers.zeros, (channels,), jnp.float32)
        used_mean, used_variance = mean.value, variance.value
        if train and not self.frozen:
            used_mean, used_variance, count = self._batch_statistics(x, valid)
            if not self.is_initializing() and self.is_mutable_collection(STATISTICS):
                unbiased = used_variance * (count / jnp.maximum(count - 1.0, 1.0))
                momentum = self.momentum if valid is None else jnp.where(count > 0, self.momentum, 0.0)
                mean.value += momentum * (used_mean - mean.value)
                variance.value += momentum * (unbiased - variance.value)
        factor = scale * lax.rsqrt(used_variance + self.epsilon)
        # Computed in float32; the result has the precision of the input.
        return (x * _like(factor, x) + _like(bias - used_mean * factor, x)).astype(x.dtype)

    def _batch_statistics(self, x, valid):
        """Return mean, biased variance and number of values per channel, over the batch axis where there is one."""
        x = x.astype(jnp.float32)
        axes = tuple(range(x.ndim - 1))
        positions = jnp.float32(x.size // x.shape[-1])
        if valid is None:
            count = self._over_batch(positions, lax.psum)
            mean = self._over_batch(x.mean(axes), lax.pmean)
            variance = self._over_batch(jnp.square(x - _like(mean, x)).mean(axes), lax.pmean)
            return mean, variance, count
        # Examples differ in the number of views, so sums are added; above, all count alike and means may be averaged.
        counted = valid.reshape((-1,) + (1,) * (x.ndim - 1))
        count = self._over_batch(valid.sum(dtype=jnp.float32) * (positions / max(len(valid), 1)), lax.psum)
        total = jnp.maximum(count, 1.0)
        mean = self._over_batch(x.sum(axes, where=counted), lax.psum) / total
        variance = self._over_batch(jnp.square(x - _like(mean, x)).sum(axes, where=counted), lax.psum) / total
        return mean, variance, count

    def _over_batch(self, value, reduce):
        if self.is_initializing():
            return value
        try:
            return reduce(value, self.axis_name)
        except NameError:  # the axis is not bound: one example on its own
            return value


def _like(vector, x):
    return vector.reshape((1,) * (x.ndim - 1) + vector.shape)
