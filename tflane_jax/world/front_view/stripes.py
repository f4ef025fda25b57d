"""Drawing stripes on the ground with exact pixel coverage (antialiasing)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.world.front_view.ground import FAR, Ground, image_columns
from tflane_jax.world.front_view.road import Highway, Stripe
from tflane_jax.world.render.camera import PinholeCamera


def draw_stripe(
    colour: Float[np.ndarray, "3 h w"], stripe: Stripe, camera: PinholeCamera, road: Highway, ground: Ground
) -> None:
    """Blend a stripe into the ground's colours, weighted by the fraction of each pixel that it covers."""
    h, w = colour.shape[1:]
    rows = ground.first_row + np.arange(h + 1) + 0.5
    left, _ = image_columns(camera, road, stripe.offset - 0.5 * stripe.width, rows, FAR)
    right, s = image_columns(camera, road, stripe.offset + 0.5 * stripe.width, rows, FAR)
    middle = 0.5 * (left + right)
    # Blur by the sideways shift of the stripe within a row, in whole pixels so that the total coverage is kept.
    blur = np.maximum(1.0, np.round(np.abs(np.diff(middle))))
    length = np.maximum(np.abs(np.diff(s)), 1e-3)
    left, right, s = left[:-1], right[:-1], s[:-1]
    seen = np.flatnonzero(np.isfinite(blur) & np.isfinite(length) & (right > -blur) & (left < w + blur))
    if not len(seen):
        return
    left, right, blur, s, length = (a[seen] for a in (left, right, blur, s, length))
    strength = np.interp(s, road.axis.s, stripe.opacity)
    if stripe.period:
        strength *= _dashed(s - stripe.phase, length, stripe.period, stripe.dash)
    first = np.clip(np.floor(left - 0.5 * blur), 0, w).astype(int)
    stop = np.clip(np.ceil(right + 0.5 * blur), 0, w).astype(int)
    line, column = _ragged(first, stop)
    u = column + 0.5
    reach = 0.5 * blur[line]
    covered = np.minimum(u + reach, right[line]) - np.maximum(u - reach, left[line])
    fraction = np.clip(covered / blur[line], 0.0, 1.0) * strength[line]
    row = seen[line]
    fraction = fraction.astype(np.float32)
    for channel, value in zip(colour, stripe.colour, strict=True):
        channel[row, column] += fraction * (np.float32(value) - channel[row, column])


def _dashed(
    s: Float[np.ndarray, " k"], length: Float[np.ndarray, " k"], period: float, dash: float
) -> Float[np.ndarray, " k"]:
    """Return the painted fraction of a stretch of road about each station."""

    def painted(x):
        whole = np.floor(x / period)
        return whole * dash + np.minimum(x - whole * period, dash)

    return (painted(s + 0.5 * length) - painted(s - 0.5 * length)) / length


def _ragged(first: Int[np.ndarray, " r"], stop: Int[np.ndarray, " r"]) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of every pixel from `first` up to `stop` in each row."""
    count = np.maximum(stop - first, 0)
    row = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    return row, np.arange(count.sum()) - start[row] + first[row]
