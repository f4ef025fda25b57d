"""Which BEV queries which camera sees, and the mean of what the cameras tell a query."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Shaped

LOST = "lost"
"""Collection of numbers of what a layer leaves out; they are counted only where a caller makes it mutable."""


@struct.dataclass
class CameraQueries:
    """The queries of V cameras: the first K of those that each sees, or all Q with a mask.

    Attributes:
        seen: whether a camera sees a query.
        index: of the K queries of a camera, ascending, filled up with Q; None stands for all queries, K = Q.
    """

    seen: Bool[Array, "v q"]
    index: Int[Array, "v k"] | None

    @classmethod
    def of(cls, seen: Bool[Array, "v q"], capacity: int | None) -> CameraQueries:
        """Return the queries that `capacity` leaves to each camera: all of them if it is None or at least Q."""
        if capacity is None or capacity >= seen.shape[1]:
            return cls(seen, None)
        return cls(seen, first_seen(seen, capacity))

    def take(self, of_query: Shaped[Array, "q ..."]) -> Shaped[Array, "v k ..."]:
        """Return a quantity of the queries for those of each camera; rows beyond them may hold anything."""
        if self.index is None:
            return jnp.broadcast_to(of_query[None], (len(self.seen), *of_query.shape))
        return of_query[self._pick(self.index)]

    def take_own(self, of_camera: Shaped[Array, "v q ..."]) -> Shaped[Array, "v k ..."]:
        """Return a quantity of queries and cameras for the queries of each; rows beyond them may hold anything."""
        if self.index is None:
            return of_camera
        pick = self._pick(self.index)
        return jnp.take_along_axis(of_camera, pick.reshape(*pick.shape, *(1,) * (of_camera.ndim - 2)), 1)

    def masked(self, taken: Float[Array, "v k ..."]) -> Float[Array, "v k ..."]:
        """Return what was taken, with zeros (and zero gradients) where a camera has no query."""
        there = self.seen if self.index is None else self.index < self.seen.shape[1]
        return jnp.where(there.reshape(*there.shape, *(1,) * (taken.ndim - 2)), taken, 0.0)

    def mean(self, found: Float[Array, "v k c"]) -> Float[Array, "q c"]:
        """Return the mean over the cameras that have a query, of features that are zero where they have none.

        Queries without a camera get zeros.
        """
        queries = self.seen.shape[1]
        if self.index is None:
            total, cameras = found.sum(0), self.seen.sum(0)
        else:
            rows = self.index.reshape(-1)
            total = jnp.zeros((queries, found.shape[-1]), found.dtype)
            total = total.at[rows].add(found.reshape(-1, found.shape[-1]), mode="drop")
            cameras = jnp.zeros(queries, jnp.int32).at[rows].add(1, mode="drop")
        return total / jnp.maximum(cameras, 1)[:, None].astype(total.dtype)

    def sow_lost(self, module: nn.Module) -> None:
        """Count in `LOST` the queries that cameras see and do not have, under the name `camera_cells`."""
        if self.index is not None and not module.is_initializing():
            lost = jnp.maximum(self.seen.sum(1) - self.index.shape[1], 0)
            module.sow(LOST, "camera_cells", lost.sum())

    def _pick(self, index: Int[Array, "v k"]) -> Int[Array, "v k"]:
        return jnp.minimum(index, self.seen.shape[1] - 1)


def first_seen(seen: Bool[Array, "v q"], capacity: int) -> Int[Array, "v capacity"]:
    """Return the indices of the first queries that each camera sees, ascending, filled up with Q."""
    cameras, queries = seen.shape
    place = jnp.cumsum(seen, 1) - 1
    place = jnp.where(seen, place, capacity)
    camera = jnp.broadcast_to(jnp.arange(cameras)[:, None], place.shape)
    query = jnp.broadcast_to(jnp.arange(queries, dtype=jnp.int32)[None], place.shape)
    return jnp.full((cameras, capacity), queries, jnp.int32).at[camera, place].set(query, mode="drop")
