"""Interface between a host and its priors: an observation of each frame, its tokens, and two hooks.

For every frame, a host calls of each prior

1. `observe`: example and memory of earlier frames to an observation; nothing is learned here,
2. `encode`: observation to prior tokens, once,
3. `into_bev`: fuses the tokens into the BEV features, in every encoder layer,
4. `into_queries`: fuses the tokens into the queries, before every decoder layer.

A prior overrides the methods that it uses. Without data, both hooks must return their input unchanged or, for a prior
that always transforms its input, such as the traffic-flow module, the result for an empty observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import flax.linen as nn
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.scene import Example


@dataclass(frozen=True)
class HostSpec:
    """Properties of a host that its priors depend on; priors have no settings for these.

    Attributes:
        dim: channels of a query.
        range: R_p, the box in which lanes are perceived, in the host's axes, metres.
        bev_range: the box that the BEV features cover and that normalised coordinates span, in the host's axes, metres.
        query_type: a query represents a whole lane ("instance": TopoNet, LaneSegNet) or one of its points ("point":
            MapTR), see TF-Lane, Eq. (3).
        bev_dim: channels of the BEV features; None for a prior that is used without them.
        forward: axis of the host's frame that points ahead of the vehicle; "y" in the axes of nuScenes' lidar.
    """

    dim: int
    range: PerceptionRange
    bev_range: PerceptionRange
    query_type: Literal["instance", "point"] = "instance"
    forward: Literal["x", "y"] = "x"
    bev_dim: int | None = None


BevHook = Callable[[int, tuple[int, int], Float[Array, "q c"], Float[Array, "q c"]], Float[Array, "q c"]]
"""Fusion of all priors into the BEV features of an encoder layer: (layer, (rows, columns) of the cells, features (q, c)
and position encodings (q, c) of the cells, row by row) -> features. Encoders call it by `fuse_priors`. The hook creates
its modules when called, so their parameters belong to the layer."""


def fuse_priors(
    fuse: BevHook | None,
    layer: int,
    bev: Float[Array, "h w c"],
    position: Callable[[], Float[Array, "h*w c"]],
) -> Float[Array, "h w c"]:
    """Return the BEV features of an encoder layer with all priors fused in; every encoder calls it in every layer.

    Args:
        fuse: the hook that the encoder got; None without priors in BEV features.
        layer: number of the layer, from 0.
        bev: features of the cells over `HostSpec.bev_range`, row 0 at the smallest y, column 0 at the smallest x.
        position: returns the position encoding of the cells, row by row; not called without a hook.
    """
    # The barriers keep XLA from fusing operations across the hook: priors without data leave features bit-identical.
    bev = lax.optimization_barrier(bev)
    if fuse is None:
        return bev
    rows, columns, channels = bev.shape
    fused = fuse(layer, (rows, columns), bev.reshape(-1, channels), position())
    return lax.optimization_barrier(fused.reshape(bev.shape))


class BevCells(NamedTuple):
    """BEV features of Q cells, as an encoder layer passes them to a prior.

    Attributes:
        features: (Q, C).
        position: (Q, C) position encoding of the cells.
        centers: (Q, 2) cell centers (x, y), metres, ego frame.
        grid: the cells, row by row; a layer may have fewer of them than another.
    """

    features: Float[Array, "q c"]
    position: Float[Array, "q c"]
    centers: Float[Array, "q 2"]
    grid: BevGrid


class HostQueries(NamedTuple):
    """Queries before a decoder layer, as a host passes them to a prior.

    Attributes:
        features: (Q, D).
        position: (Q, D) position encoding.
        reference: (Q, P, 2 or 3) reference line, or single reference point, of each query, in [0, 1] of
            `HostSpec.bev_range`.
        mask: (Q, Q) [i, j] query i may attend to query j; None: all to all. A host with groups of
            queries that must not exchange information (MapTRv2's one-to-one and one-to-many groups) masks them here.
        groups: numbers of queries of these groups, one after the other; () for a single group. A prior whose own tokens
            read queries needs them: nothing may pass from one group to another by way of the tokens.
    """

    features: Float[Array, "q d"]
    position: Float[Array, "q d"]
    reference: Float[Array, "q p c"]
    mask: Bool[Array, "q q"] | None = None
    groups: tuple[int, ...] = ()

    def check(self, host: HostSpec) -> None:
        """Raise ValueError for queries of other channels than the host's, or arrays that do not fit together."""
        for name, found in (("features", self.features), ("position", self.position)):
            if found.ndim != 2 or found.shape[1] != host.dim:
                shape, wanted = tuple(found.shape), f"(Q, HostSpec.dim) = (Q, {host.dim})"
                raise ValueError(f"{name} of the queries have shape {shape}, expected {wanted}")
        count = len(self.features)
        fits = {
            f"position: (Q, D) with Q = {count}": len(self.position) == count,
            f"reference: (Q, P, 2 or 3) with Q = {count}": self.reference.ndim == 3
            and self.reference.shape[0] == count
            and self.reference.shape[2] in (2, 3),
            f"mask: (Q, Q) with Q = {count}": self.mask is None or self.mask.shape == (count, count),
        }
        if wrong := [what for what, right in fits.items() if not right]:
            name, _, wanted = wrong[0].partition(": ")
            raise ValueError(f"{name} of the queries has shape {tuple(getattr(self, name).shape)}, expected {wanted}")


class Prior:
    """A prior in one host; subclasses override the methods that they use.

    Each prior defines its own pytrees of observations, tokens and memories; the host only passes them on.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    """Fields of `Example` that `observe` reads; others need not be loaded."""

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules that `encode` calls, by their parameter names in the host."""
        return {}

    def start(self) -> Any:
        """Return the memory before the first frame of a sequence; None for a prior without memory."""
        return None

    def observe(self, example: Example, memory: Any) -> tuple[Any, Any]:
        """Return the observation of this frame, and the memory for the next frame.

        Args:
            example: one frame; the fields that the prior reads may be None.
            memory: of the previous frame; None for a single frame, and the returned memory is then None too.
        """
        raise NotImplementedError

    def encode(self, observation: Any, *, deterministic: bool) -> Any:
        """Return the prior tokens; dropout (`deterministic=False`) needs the random key `dropout`."""
        del deterministic
        return observation

    def into_bev(self, tokens: Any, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return the BEV features of an encoder layer with the prior fused in; new modules belong to the encoder."""
        del tokens, layer
        return cells.features

    def into_queries(self, tokens: Any, layer: int, queries: HostQueries) -> Float[Array, "q d"]:
        """Return the queries before a decoder layer with the prior fused in; new modules belong to the host."""
        del tokens, layer
        return queries.features

    def fuses_into_bev(self) -> bool:
        """Return whether the prior uses `into_bev`: by default, whether it overrides it."""
        return type(self).into_bev is not Prior.into_bev


@runtime_checkable
class PriorConfig(Protocol):
    """The configuration of a prior: a frozen dataclass.

    It may have a method `host_limits(host: HostSpec) -> Rules`: what its settings demand of the host, in the form of
    `limits()`; the host checks it with its own.
    """

    def build(self, host: HostSpec) -> Prior:
        """Return the prior for a host."""
        ...
