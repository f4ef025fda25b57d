"""MapTRv2's loss (Liao et al. 2024): that of MapTR, of a one-to-many group, of masks of lines, and of depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import Count, PositiveOrZero
from tflane_jax.losses.common import Terms
from tflane_jax.losses.map_masks import bev_line_mask, depth_targets, view_line_masks
from tflane_jax.losses.maptr import LineTargets, MapTrLossConfig, assign_lines, line_losses
from tflane_jax.scene import Example, LinePrediction


@dataclass(frozen=True)
class MapTrV2LossConfig(MapTrLossConfig):
    """Weights of matching costs and loss terms; the defaults are MapTRv2's.

    Attributes:
        many_repeats: k, how often every true line is repeated for the one-to-many group.
        many_weight: weight of all terms of the one-to-many group.
        mask_weight: weight of the mask on the BEV features.
        mask_positive: weight of a cell with a line in it, relative to one without.
        view_mask_weight, view_mask_positive: the same of the masks on the feature maps of the images.
        depth_weight: weight of the depth of image cells.
        others: see `MapTrLossConfig`.
    """

    many_repeats: Count = 6
    many_weight: PositiveOrZero = 1.0
    mask_weight: PositiveOrZero = 1.0
    mask_positive: PositiveOrZero = 4.0
    view_mask_weight: PositiveOrZero = 2.0
    view_mask_positive: PositiveOrZero = 1.0
    depth_weight: PositiveOrZero = 3.0

    def auxiliary_terms(self, name: str, output: Any, targets: LineTargets, batch: Example, host: Any) -> Terms:
        """Return the weighted losses of an auxiliary output, see `MapTrLossConfig.auxiliary_terms`."""
        range_ = host.bev_range
        lines = cast(Any, batch.map_lines).of_classes(host.decoder.classes)  # masks show no lines of other classes
        views: Any = batch.cameras
        if name == "one_to_many":
            terms = one_to_many_losses(output, targets, range_, self)
            return {f"many_{key}": self.many_weight * value for key, value in terms.items()}
        if name == "line_mask":
            over = jax.vmap(host.lines_over_bev)(lines, batch)
            masks = jax.vmap(partial(bev_line_mask, shape=output.shape[-2:], range_=range_))(over)
            return {"mask": self.mask_weight * mask_loss(output, masks, self.mask_positive)[None]}
        if name == "view_line_masks":
            seen = jax.vmap(host.lines_in_views)(lines, batch)
            masks = jax.vmap(partial(view_line_masks, shape=output.shape[-2:]))(seen, views)
            there = views.valid[..., None, None]
            return {"view_mask": self.view_mask_weight * mask_loss(output, masks, self.view_mask_positive, there)[None]}
        if name == "depth":
            low, high, step = host.encoder.bev.depth
            each = partial(depth_targets, shape=output.shape[2:4], low=low, high=high, step=step)
            bins, valid = jax.vmap(each)(views)
            return {"depth": self.depth_weight * depth_loss(output, bins, valid)[None]}
        return super().auxiliary_terms(name, output, targets, batch, host)


def one_to_many_losses(
    prediction: LinePrediction, targets: LineTargets, range_: PerceptionRange, config: MapTrV2LossConfig
) -> Terms:
    """Return the `line_losses` of a group that learns every true line `many_repeats` times.

    Args:
        prediction: leading axes (batch, layer).
        targets: ground truth, leading axis batch.
        range_: the box that normalised coordinates span, metres.
        config: weights.
    """
    repeats = config.many_repeats
    assignment = assign_lines(prediction, targets, range_, config, repeats)
    repeated = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * repeats, 1), targets)
    return line_losses(prediction, assignment, repeated, range_, config)


def mask_loss(
    logits: Float[Array, "*b"], mask: Bool[Array, "*b"], positive: float, valid: Bool[Array, "*c"] | None = None
) -> Float[Array, ""]:
    """Return the mean cross-entropy over cells, those of the mask weighted by `positive`.

    With `valid`, which broadcasts against the cells, it is the mean over the valid ones; 0 without any.
    """
    true = mask.astype(logits.dtype)
    if valid is not None:
        valid = jnp.broadcast_to(valid, logits.shape)
        logits = jnp.where(valid, logits, 0.0)
    weight = jnp.where(true > 0, positive, 1.0)
    every = weight * optax.losses.sigmoid_binary_cross_entropy(logits, true)
    if valid is None:
        return every.mean()
    return jnp.where(valid, every, 0.0).sum() / jnp.maximum(valid.sum(dtype=every.dtype), 1)


def depth_loss(logits: Float[Array, "*b d"], bins: Int[Array, "*b"], valid: Bool[Array, "*b"]) -> Float[Array, ""]:
    """Return the mean of -log p of the true depth bins, over the cells that have one; 0 without any.

    Args:
        logits: of the bins.
        bins, valid: targets, see `losses.map_masks.depth_targets`.
    """
    chosen = jnp.take_along_axis(jax.nn.log_softmax(logits, -1), bins[..., None], -1)[..., 0]
    return -jnp.where(valid, chosen, 0.0).sum() / jnp.maximum(valid.sum(dtype=logits.dtype), 1)
