"""The list of all priors, and the steps that apply to each of them.

A new prior is a file with a `Prior` and its configuration, and one line in `PriorsConfig` or in a subclass of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax.errors import AssignSubModuleError, CallCompactUnboundModuleError
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.prior import BevCells, BevHook, HostQueries, HostSpec, Prior, PriorConfig
from tflane_jax.models.sd_map_encoder import SdMapModuleConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.scene import Example

ByPrior = dict[str, Any]
"""Observations, tokens or memories of several priors, by their names in `PriorsConfig`."""


@dataclass(frozen=True)
class PriorsConfig:
    """The priors of a host, None for an absent one; they are fused in this order.

    Attributes:
        traffic_flow: tracks of other road users, into the queries (TF-Lane) and, if chosen, into the BEV features.
        sd_map: an SD map, into the BEV features (SMERF).
        markers: fiducial markers, into the BEV features (Wu and Hu).
    """

    traffic_flow: TrafficFlowConfig | None = None
    sd_map: SdMapModuleConfig | None = None
    markers: MarkerFusionConfig | None = None

    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""

    def build(self, host: HostSpec) -> dict[str, Prior]:
        """Return the priors that are configured, by name."""
        return {name: config.build(host) for name, config in self.configured.items()}

    @property
    def configured(self) -> dict[str, PriorConfig]:
        """The configurations of those that are not None, by name."""
        configs: dict[str, PriorConfig | None] = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: config for name, config in configs.items() if config is not None}


def start_memories(priors: Mapping[str, Prior]) -> ByPrior:
    """Return the memories before the first frame of a sequence, of the priors that have one."""
    memories = {name: prior.start() for name, prior in priors.items()}
    return {name: memory for name, memory in memories.items() if memory is not None}


def observe(priors: Mapping[str, Prior], example: Example, memories: ByPrior) -> tuple[ByPrior, ByPrior]:
    """Return the observations of one frame, and the memories for the next.

    Args:
        priors: of the host.
        example: one frame.
        memories: of the previous frame, by name; a prior without an entry has no memory.
    """
    observations, following = {}, {}
    for name, prior in priors.items():
        observations[name], memory = prior.observe(example, memories.get(name))
        if memory is not None:
            following[name] = memory
    return observations, following


def observe_clip(priors: Mapping[str, Prior], clip: Example) -> ByPrior:
    """Return the observations of successive frames of one scene (leading axis on every leaf)."""
    start = start_memories(priors)
    remembering = {name: prior for name, prior in priors.items() if name in start}
    alone = {name: prior for name, prior in priors.items() if name not in start}

    def body(memories: ByPrior, frame: Example) -> tuple[ByPrior, ByPrior]:
        observations, memories = observe(remembering, frame, memories)
        return memories, observations

    observations = jax.vmap(lambda frame: observe(alone, frame, {})[0])(clip) if alone else {}
    return observations | (lax.scan(body, start, clip)[1] if remembering else {})


def encode(priors: Mapping[str, Prior], observations: ByPrior, *, deterministic: bool) -> ByPrior:
    """Return the tokens of every prior; raise UserError for one that calls a module which it does not name."""
    tokens = {}
    for name, prior in priors.items():
        try:
            tokens[name] = prior.encode(observations[name], deterministic=deterministic)
        except (CallCompactUnboundModuleError, AssignSubModuleError) as error:
            raise UserError(
                f"encode of the prior {name} calls a module that is not part of the host: make it in __init__ and "
                f"return it from modules(), which has {', '.join(prior.modules()) or 'none'}"
            ) from error
    return tokens


def bev_hook(priors: Mapping[str, Prior], tokens: ByPrior, host: HostSpec) -> BevHook | None:
    """Return the fusion of all priors into the layers of a BEV encoder; None if no prior fuses into BEV features."""
    fusing = {name: prior for name, prior in priors.items() if prior.fuses_into_bev()}
    if not fusing:
        return None

    def fuse(layer: int, shape: tuple[int, int], bev: Float[Array, "q c"], position: Float[Array, "q c"]):
        grid = BevGrid(host.bev_range, *shape)
        centers = host.bev_range.denormalise(jnp.asarray(cell_points(grid)))
        for name, prior in fusing.items():
            fused = prior.into_bev(tokens[name], layer, BevCells(bev, position, centers, grid))
            bev = _alike(f"into_bev of the prior {name}", fused, bev)
        return bev

    return fuse


def fuse_into_queries(
    priors: Mapping[str, Prior], tokens: ByPrior, layer: int, queries: HostQueries
) -> Float[Array, "q d"]:
    """Return the queries before a decoder layer with every prior fused in."""
    for name, prior in priors.items():
        fused = prior.into_queries(tokens[name], layer, queries)
        queries = queries._replace(features=_alike(f"into_queries of the prior {name}", fused, queries.features))
    return queries.features


def _alike(what: str, found: Any, features: Array) -> Array:
    """Return what a prior made of features; raise UserError for another shape, which broadcasting would hide."""
    if getattr(found, "shape", None) != features.shape:
        shown = f"an array of shape {found.shape}" if hasattr(found, "shape") else type(found).__name__
        raise UserError(f"{what} returned {shown}, expected {features.shape}, the shape of the features it was given")
    return found
