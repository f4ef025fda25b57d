"""SMERF (Luo et al. 2024; docs/reference/smerf.md): an SD map as tokens, to which BEV queries attend.

The map is encoded once per frame; every layer of the BEV encoder fuses the tokens after spatial attention.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.masks import key_mask, radius_mask
from tflane_jax.layers.polyline_encoder import PolylineEncoder, PolylineEncoderConfig
from tflane_jax.layers.precision import run_part
from tflane_jax.models.prior import BevCells, HostSpec, Prior
from tflane_jax.models.token_fusion import TokenFusionConfig, attend_to_tokens
from tflane_jax.priors.sd_map import SdMapPriorConfig, sd_map_lines
from tflane_jax.scene import Example, SdMap


@dataclass(frozen=True)
class SdMapModuleConfig(TokenFusionConfig):
    """Sizes of encoder and fusion. The defaults are SMERF's; `SMALL_SD_MAP` trains on two CPU cores.

    Attributes:
        prior: coordinates and labels.
        lines: encoder of polylines.
        heads, width, norm, radius, precision, remat: see `TokenFusionConfig`; SMERF's are the defaults.
        absent: if no cell may attend to a line, because none is valid or, with a radius, near a cell, "nothing" leaves
            the BEV features exactly as they are; "reference" adds the bias of the attention's output and normalises, as
            the published code, which has no radius, does for an empty map in a batch.
    """

    prior: SdMapPriorConfig = SdMapPriorConfig()
    lines: PolylineEncoderConfig = PolylineEncoderConfig()
    norm: Literal["sum", "query"] = "sum"
    absent: Literal["nothing", "reference"] = "nothing"

    def build(self, host: HostSpec) -> SdMapPrior:
        """Return the prior for a host."""
        return SdMapPrior(self, host)


SMALL_SD_MAP = SdMapModuleConfig(
    # A road extends about 7 m to each side of its line, and the line is a few metres off.
    lines=PolylineEncoderConfig(dim=64, layers=2, hidden=128, dropout=0.0),
    width=64,
    norm="query",
    radius=10.0,
)

# Points per line of the empty map that replaces an absent one.
POINTS = 11


class EncodedSdMap(NamedTuple):
    """Prior tokens of a frame's SD map, as every BEV layer reads them.

    Attributes:
        tokens: (R, D) one token per line.
        valid: (R,) False in padding.
        sd_map: the lines themselves.
    """

    tokens: Float[Array, "r d"]
    valid: Bool[Array, " r"]
    sd_map: SdMap


class SdMapPrior(Prior):
    """Tokens of an SD map, fused into every layer of the BEV encoder."""

    reads = ("sd_map",)

    def __init__(self, config: SdMapModuleConfig, host: HostSpec):
        self.config = config
        self.sd_map_tokens = SdMapEncoder(config, host.bev_range)

    def modules(self) -> dict[str, nn.Module]:
        """Return the line encoder."""
        return {"sd_map_tokens": self.sd_map_tokens}

    def observe(self, example: Example, memory: None) -> tuple[SdMap, None]:
        """Return the SD map; without one, a map without lines."""
        sd_map = SdMap.empty(0, POINTS) if example.sd_map is None else example.sd_map
        return jax.tree.map(jnp.asarray, sd_map), None

    def encode(self, observation: SdMap, *, deterministic: bool) -> EncodedSdMap:
        """Return the tokens of the lines."""
        return EncodedSdMap(*self.sd_map_tokens(observation, deterministic=deterministic), observation)

    def into_bev(self, tokens: EncodedSdMap, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return the BEV features with the map fused in."""
        fusion = SdMapFusion(self.config, name=f"sd_map_{layer}")
        mask = sd_map_mask(tokens.sd_map, cells.centers, self.config)
        return fusion(cells.features, cells.position, tokens.tokens, tokens.valid, mask)


class SdMapEncoder(nn.Module):
    """From an SD map to one token per line.

    Attributes:
        config: sizes.
        range: the box that normalised coordinates span, that of the host's BEV features.
    """

    config: SdMapModuleConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, sd_map: SdMap, *, deterministic: bool = True) -> tuple[Float[Array, "r d"], Bool[Array, " r"]]:
        """Return the tokens, 0 in padding, and their validity.

        Args:
            sd_map: one frame's map. Parameter shapes depend on the number of points per line; parameters initialised
                without a map fit lines of 11 points, the default of `ExampleConfig.sd_map`.
            deterministic: no dropout. False needs the random key `dropout`.
        """
        lines = sd_map_lines(jax.tree.map(jnp.asarray, sd_map), self.config.prior, self.range)
        if not len(lines.valid) and not self.is_initializing():
            # Parameters for any number of points fit a map without lines.
            return jnp.zeros((0, self.config.lines.dim)), lines.valid
        encoder = PolylineEncoder(self.config.lines, self.config, name="lines")
        return encoder(lines.points, lines.labels, lines.valid, deterministic=deterministic), lines.valid


class SdMapFusion(nn.Module):
    """Masked attention of BEV queries to the lines of the map, residual, norm."""

    config: SdMapModuleConfig

    @nn.compact
    def __call__(
        self,
        bev: Float[Array, "q c"],
        position: Float[Array, "q c"],
        tokens: Float[Array, "r d"],
        valid: Bool[Array, " r"],
        mask: Bool[Array, "q r"] | None = None,
    ) -> Float[Array, "q c"]:
        """Return the BEV features after the fusion; if no cell attends to a line, see `SdMapModuleConfig.absent`.

        Args:
            bev, position: features of the cells and their position encoding.
            tokens, valid: of the lines.
            mask: which cell may attend to which line, see `sd_map_mask`; None: to all valid lines.
        """
        return run_part(self, SdMapFusion._fuse, self.config, bev, position, tokens, valid, mask)

    def _fuse(self, bev, position, tokens, valid, mask) -> Float[Array, "q c"]:
        """Return the BEV features; called by the compact method."""
        config, mask = self.config, key_mask(valid) if mask is None else mask
        present = mask.any()

        def change(found):
            if config.absent == "nothing":
                return found
            # Attention without keys: published code has 0 before the output projection, this one after it.
            return jnp.where(present, found, self.variables["params"]["attention"]["output"]["bias"][None])

        fused = attend_to_tokens(config, bev, position, tokens, mask, change)
        return fused if config.absent == "reference" else jnp.where(present, fused, bev)


def sd_map_mask(sd_map: SdMap, cells: Float[ArrayLike, "q 2"], config: SdMapModuleConfig) -> Bool[Array, "q r"] | None:
    """Return which BEV cell, centered at (x, y) in metres, may attend to which line of the map; None: to all."""
    if config.radius is None:
        return None
    return radius_mask(jnp.asarray(cells), jnp.asarray(sd_map.points), jnp.asarray(sd_map.valid), config.radius)
