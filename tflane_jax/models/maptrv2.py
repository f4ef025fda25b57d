"""MapTRv2 (Liao et al. 2024), with or without priors: MapTR with decoupled attention and one-to-many training.

Differences from MapTR (`models.maptr`): image features are lifted into BEV by their depth (`models.lift`);
self-attention runs among lines and, apart from that, along each line; in training, a second group of queries learns
from true lines that are repeated, BEV and image features learn masks of the lines, and the lift learns depth. Source:
docs/reference/maptrv2.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import flax.linen as nn
import jax
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.deformable import DeformableAttention
from tflane_jax.layers.precision import run_layer
from tflane_jax.layers.transformer import FeedForward, TransformerConfig, add_and_norm
from tflane_jax.limits import CountOrZero, Rules, check_settings
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName, LineMaskHead
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.host import Host
from tflane_jax.models.lidar_axes import raster_in_ego_axes
from tflane_jax.models.lift import LiftConfig
from tflane_jax.models.map_lines import PAPER_LINE_DECODER, LineDecoderConfig, LineQueries
from tflane_jax.models.maptr import PAPER_MAP_ENCODER, PAPER_RANGE, MapTr, MapTrConfig, turned
from tflane_jax.models.priors import ByPrior
from tflane_jax.scene import MapLines, Prediction


@dataclass(frozen=True, kw_only=True)
class MapTrV2Config(MapTrConfig):
    """Configuration of MapTRv2; without priors, the vision-only baseline.

    Attributes:
        many: lines of the one-to-many group; 0 for none. Not together with `denoising`.
        line_mask: whether the BEV features learn a mask of all lines.
        decoder, denoising, encoder, range, priors: see `MapTrConfig`.
    """

    many: CountOrZero = 0
    line_mask: bool = False

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Those of MapTR, the one-to-many group, and those that BEV and image features learn."""
        own: dict[AuxiliaryName, bool] = {"one_to_many": self.many > 0, "line_mask": self.line_mask}
        learned: dict[AuxiliaryName, str] = getattr(self.encoder, "learned", {})
        return (*super().auxiliary, *(name for name, wanted in own.items() if wanted), *learned)

    def build(self) -> Host:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return MapTrV2(self)

    def limits(self) -> Rules:
        """Those of MapTR, and one group of further queries in training."""
        yield from super().limits()
        yield "many", not self.many or self.denoising is None, "0 with denoising: both add queries in training"


PAPER_LIFT_ENCODER = CameraEncoderConfig(PAPER_MAP_ENCODER.images, LiftConfig(supervised=True), line_masks=True)


def paper_config() -> MapTrV2Config:
    """Return the published sizes on nuScenes: ResNet-50, six cameras, 200 x 100 cells, 50 and 300 lines."""
    return MapTrV2Config(
        encoder=PAPER_LIFT_ENCODER,
        range=PAPER_RANGE,
        decoder=PAPER_LINE_DECODER,
        initial="xavier",
        many=300,
        line_mask=True,
    )


class MapTrV2(MapTr):
    """From one example to the predictions of every decoder layer."""

    config: MapTrV2Config

    @nn.compact
    def decode(
        self,
        bev: Float[Array, "h w e"],
        tokens: ByPrior | None = None,
        lines: MapLines | None = None,
        *,
        deterministic: bool = True,
        level: Float[Array, "4 4"] | None = None,
    ) -> Prediction:
        """Return the lines of every decoder layer from BEV features and prior tokens, as `MapTr.decode` does.

        Sows the lines of the one-to-many group as the auxiliary output `one_to_many`, and the mask as `line_mask`.
        """
        config, count = self.config, self.config.decoder.queries
        training = self.is_mutable_collection(AUXILIARY)
        if config.line_mask and training:
            mask = LineMaskHead(name="mask_head")(bev)
            self.sow(AUXILIARY, "line_mask", mask if level is None else raster_in_ego_axes(mask))
        if not config.many:
            return turned(self.decode_one_to_one(bev, tokens, lines, deterministic), level)
        start = LineQueries(config.decoder, config.spec.bev_range, config.many, name="queries")()
        if not training:
            start = jax.tree.map(lambda leaf: leaf[:count], start)
        found = turned(self.decode_queries(start, bev, tokens or {}, deterministic), level)
        if training:
            self.sow(AUXILIARY, "one_to_many", jax.tree.map(lambda leaf: leaf[:, count:], found.lines))
        return jax.tree.map(lambda leaf: leaf[:, :count], found)

    def groups(self, lines: int) -> tuple[int, ...]:
        """Return the numbers of lines of the one-to-one and the one-to-many group; () without the second."""
        first = self.config.decoder.queries
        return (first, lines - first) if lines > first else ()

    def attend(self, layer, queries, placed, reference, bev, together, deterministic):
        """Return the queries after a decoder layer of decoupled attention; see `MapTr.attend`."""
        config = self.config.decoder
        module = partial(DecoupledLayer, config, name=f"layer_{layer}")
        return run_layer(self, module, config, queries, placed, reference, bev, together, deterministic=deterministic)


class DecoupledLayer(nn.Module):
    """Self-attention among lines, then among the points of a line, deformable attention, feed-forward; post-norm.

    Attributes:
        config: sizes.
    """

    config: LineDecoderConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "i p c"],
        position: Float[Array, "i p c"],
        reference: Float[Array, "i p d"],
        bev: Float[Array, "h w e"],
        together: Bool[Array, "i i"] | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "i p c"]:
        """Return the queries after the layer.

        Args:
            queries, position: content of the queries and the position encoding added to it in attention.
            reference: points in [0, 1].
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            together: which line may attend to which; None: all to all.
            deterministic: no dropout.
        """
        config, (h, w, e) = self.config, bev.shape

        add = partial(add_and_norm, dropout=config.dropout, deterministic=deterministic)

        def among(axis, mask, name):
            """Attention among the queries along an axis, for each index of the other one."""
            attend = nn.vmap(
                _SelfAttention,
                in_axes=(1 - axis, 1 - axis, None, None),  # pyright: ignore[reportArgumentType]
                out_axes=1 - axis,
                variable_axes={"params": None, "intermediates": 0},
                split_rngs={"params": False, "dropout": True},
            )
            module = attend(config.dim, config.heads, config.dropout, name=name)
            return add(name, queries, module(queries, queries + position, mask, deterministic))

        queries = among(0, together, "line_attention")
        queries = among(1, None, "point_attention")
        sample = DeformableAttention(config.dim, config.heads, config.sampling_points, name="bev_attention")
        placed = (queries + position).reshape(-1, config.dim)
        around = reference[..., :2].reshape(-1, 1, 2)
        sampled = sample(placed, bev.reshape(h * w, e), ((h, w),), around)
        queries = add("bev_attention", queries, sampled.reshape(queries.shape))
        block = FeedForward(TransformerConfig(config.heads, config.hidden, config.dropout), name="feed_forward")
        return add("feed_forward", queries, block(queries, deterministic=deterministic))


class _SelfAttention(nn.Module):
    """Attention among queries, with positional arguments for `nn.vmap`."""

    dim: int
    heads: int
    dropout: float

    @nn.compact
    def __call__(self, queries, placed, mask, deterministic):
        attention = MultiHeadAttention(self.dim, self.heads, self.dropout, name="attention")
        return attention(placed, placed, queries, mask, deterministic=deterministic)
