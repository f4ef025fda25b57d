"""Feature pyramid network (Lin et al. 2017) with MMDetection's extra levels (`add_extra_convs="on_output"`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tflane_jax.layers.pointwise import convolve
from tflane_jax.limits import Count

_INIT = nn.initializers.xavier_uniform()


@dataclass(frozen=True)
class FeaturePyramidConfig:
    """Sizes of the pyramid.

    Attributes:
        dim: channels of every level.
        levels: levels out; those beyond the input's are convolutions of stride 2 on the coarsest output.
    """

    dim: Count = 256
    levels: Count = 4


class FeaturePyramid(nn.Module):
    """Maps the features of a backbone's stages to levels of one width.

    Attributes:
        config: sizes.
    """

    config: FeaturePyramidConfig

    @nn.compact
    def __call__(self, features: Sequence[Float[Array, "v _h _w _c"]]) -> list[Float[Array, "v _h _w d"]]:
        """Return the levels, finest first; raises ValueError where fewer levels are wanted than stages are given."""
        levels, given = self.config.levels, len(features)
        if levels < given:
            raise ValueError(f"a pyramid of {levels} levels cannot hold the features of {given} stages")
        merged = [self._conv(1, 1, f"lateral_{i}")(x) for i, x in enumerate(features)]
        for i in reversed(range(given - 1)):
            merged[i] = merged[i] + enlarge(merged[i + 1], *merged[i].shape[1:3])
        outputs = [self._conv(3, 1, f"output_{i}")(x) for i, x in enumerate(merged)]
        for i in range(given, levels):
            # MMDetection's `relu_before_extra_convs` has no effect on the first extra level.
            x = outputs[-1] if i == given else nn.relu(outputs[-1])
            outputs.append(self._conv(3, 2, f"output_{i}")(x))
        return outputs

    def _conv(self, size: int, stride: int, name: str) -> nn.Conv:
        padding = [(size // 2, size // 2)] * 2
        return nn.Conv(
            self.config.dim,
            (size, size),
            (stride, stride),
            padding,
            kernel_init=_INIT,
            conv_general_dilated=convolve,
            name=name,
        )


def enlarge(x: Float[Array, "v h w c"], height: int, width: int) -> Float[Array, "v height width c"]:
    """Return the nearest cell, floor(i * small / large), for every cell of a larger map."""
    for axis, size in ((1, height), (2, width)):
        small = x.shape[axis]
        if size == 2 * small:  # the gradient is a plain sum, not a scatter
            x = jnp.repeat(x, 2, axis)
        elif size != small:
            x = jnp.take(x, np.arange(size) * small // size, axis)
    return x
