"""Variants of TF-Lane's masks: which lanes see which road users, and which frames of a track see each other.

By default every lane may attend to every valid instance; the paper names the quadrants L->T and T->L of M_s (Fig. 5)
and does not define them. The restrictions here are composed with M_s by "and"; each is a setting of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.masks import SpatialMask, causal_mask, key_mask, nearest_mask, track_distance
from tflane_jax.limits import Count, PositiveOrInfinite
from tflane_jax.models.prior import HostQueries
from tflane_jax.priors.traffic_flow import SelectedTracks


@dataclass(frozen=True)
class TrafficMaskConfig:
    """Restrictions of the TFM's attention; the defaults are the paper's masks.

    Distances are those between the reference line of a lane query and the nearest valid position of a track.

    Attributes:
        softmax: "quadrants" has one softmax for each fusion module; "joint" one for lanes and traffic together, under
            the whole M_s, in place of the fusion modules.
        window: metres; lanes and instances further apart do not see each other. None: no limit.
        nearest: a lane sees only so many nearest instances. None: all.
        head_windows: window of each head, metres, infinity allowed; () for none.
        temporal: "all": a frame of a track attends to all valid frames, as in Fig. 4; "causal": to itself and earlier
            ones.
    """

    softmax: Literal["quadrants", "joint"] = "quadrants"
    window: PositiveOrInfinite | None = None
    nearest: Count | None = None
    head_windows: tuple[PositiveOrInfinite, ...] = ()
    temporal: Literal["all", "causal"] = "all"

    @property
    def local(self) -> bool:
        """Whether the spatial mask depends on distances."""
        return self.window is not None or self.nearest is not None or bool(self.head_windows)


def spatial_mask(
    config: TrafficMaskConfig, queries: HostQueries, tracks: SelectedTracks, bev_range: PerceptionRange
) -> SpatialMask:
    """Return M_s with the restrictions of `config`.

    Args:
        config: restrictions.
        queries: of the host.
        tracks: selected instances.
        bev_range: the box that the queries' reference lines span.
    """
    mask = SpatialMask.from_validity(len(queries.features), tracks.valid, queries.mask)
    if not config.local:
        return mask
    lanes = bev_range.denormalise(jax.lax.stop_gradient(queries.reference))
    distance = track_distance(lanes[..., :2], tracks.position[..., :2], tracks.frame_valid)
    if config.window is not None:
        mask = mask.restricted(distance <= config.window)
    if config.nearest is not None:
        mask = mask.restricted(nearest_mask(distance, config.nearest))
    if config.head_windows:
        mask = mask.restricted(distance[None] <= jnp.asarray(config.head_windows)[:, None, None])
    return mask


def temporal_mask(config: TrafficMaskConfig, frame_valid: Bool[Array, "t n"]) -> Bool[Array, "t #n n"]:
    """Return the temporal mask of every instance (Fig. 4): frames attend to valid frames."""
    mask = jax.vmap(key_mask)(frame_valid)
    return mask if config.temporal == "all" else mask & causal_mask(frame_valid.shape[1])[None]


def sees_any(quadrant: Bool[Array, "*h q k"]) -> Bool[Array, "q 1"]:
    """Return whether a query sees any key in any head."""
    seen = quadrant.any(-1, keepdims=True)
    return seen.any(0) if seen.ndim == 3 else seen
