"""What a prior is to a host: an observation of each frame, its tokens, and two hooks.

For every frame, a host

1. lets each prior `observe` the example, beside what the prior remembers of earlier frames; nothing here is learned,
2. lets it `encode` the observation to tokens, once,
3. offers it the BEV features of every encoder layer (`into_bev`),
4. offers it the queries in front of every decoder layer (`into_queries`).

A prior overrides what it uses. Where nothing was observed, both hooks must return exactly what came in or, for a prior
with parameters of its own such as the traffic-flow module, what they return for an empty observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import flax.linen as nn
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import Example


@dataclass(frozen=True)
class HostSpec:
    """What a host tells its priors about itself; no prior has a setting for any of it.

    Attributes:
        dim: channels of a query.
        range: R_p, the box in which lanes are perceived, metres.
        bev_range: the box that the BEV features cover and that normalised coordinates span, metres.
        query_type: what a query represents: a whole lane ("instance": TopoNet, LaneSegNet) or one of its points
            ("point": MapTR). TF-Lane, Eq. (3).
    """

    dim: int
    range: PerceptionRange
    bev_range: PerceptionRange
    query_type: Literal["instance", "point"] = "instance"


BevHook = Callable[[int, Any, Float[Array, "q c"], Float[Array, "q c"]], Float[Array, "q c"]]
"""What priors add to the BEV features of an encoder layer: (layer, cell centers (q, 2) in [0, 1], features (q, c),
position encodings (q, c)) -> features. It makes its modules inside, so that their parameters belong to the layer."""


class BevCells(NamedTuple):
    """BEV features of Q cells, as an encoder layer hands them to a prior.

    Attributes:
        features: (Q, C).
        position: (Q, C) position encoding of the cells.
        centers: (Q, 2) where the cells lie, metres.
    """

    features: Float[Array, "q c"]
    position: Float[Array, "q c"]
    centers: Float[Array, "q 2"]


class HostQueries(NamedTuple):
    """Queries in front of a decoder layer, as a host hands them to a prior.

    Attributes:
        features: (Q, D).
        position: (Q, D) position encoding.
        mask: (Q, Q) [i, j] query i may attend to query j; None where all may attend to all. A host with groups of
            queries that must not exchange information (MapTRv2's one-to-one and one-to-many groups) masks them here.
    """

    features: Float[Array, "q d"]
    position: Float[Array, "q d"]
    mask: Bool[Array, "q q"] | None = None


class Prior:
    """A prior in one host; subclasses override what they use.

    Observations, tokens and memories are pytrees of the prior's own; the host only passes them on.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    """Fields of `Example` that `observe` reads, so that data without the others can be loaded."""

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules that `encode` calls, by the name of their parameters in the host."""
        return {}

    def start(self) -> Any:
        """Return the memory before the first frame of a sequence; None for a prior without memory."""
        return None

    def observe(self, example: Example, memory: Any) -> tuple[Any, Any]:
        """Return what the prior knows of this frame, and the memory for the next frame.

        Args:
            example: one frame; the field that the prior reads may be None.
            memory: of the frame before; None for a frame on its own, and then None comes back.
        """
        raise NotImplementedError

    def encode(self, observation: Any, *, deterministic: bool) -> Any:
        """Return the tokens of an observation; with dropout (not `deterministic`) the key `dropout` is needed."""
        del deterministic
        return observation

    def into_bev(self, tokens: Any, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return the BEV features of an encoder layer with the prior fused in; modules belong to the encoder."""
        del tokens, layer
        return cells.features

    def into_queries(self, tokens: Any, layer: int, queries: HostQueries) -> Float[Array, "q d"]:
        """Return the queries in front of a decoder layer with the prior fused in; modules belong to the host."""
        del tokens, layer
        return queries.features

    def fuses_into_bev(self) -> bool:
        """Return whether the prior has a say in BEV features."""
        return type(self).into_bev is not Prior.into_bev


class PriorConfig(Protocol):
    """The configuration of a prior: a frozen dataclass."""

    def build(self, host: HostSpec) -> Prior:
        """Return the prior for a host."""
        ...
