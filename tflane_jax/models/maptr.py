"""MapTR (Liao et al. 2023), with or without priors: the lines of a vector map, by class.

Images -> BEV encoder (SD map, markers, optional traffic raster) -> instance and point queries -> decoder layers, each
moving all points (traffic flow before each) -> classes and points of every layer. The small version reads BEV evidence
instead of images; decoder, heads and losses are the same. Source: docs/reference/maptr.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import Rules, check_settings
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.image_encoder import PAPER_IMAGE_ENCODER
from tflane_jax.models.lane_decoder import LaneDecoderLayer
from tflane_jax.models.lane_denoising import DenoisingConfig, decode_groups
from tflane_jax.models.lidar_axes import (
    InLidarAxes,
    in_lidar_axes,
    level_pose,
    lines_below_lidar,
    lines_beside_lidar,
    lines_in_ego_axes,
    range_in_ego_axes,
    range_in_lidar_axes,
)
from tflane_jax.models.map_lines import (
    PAPER_LINE_DECODER,
    LineDecoderConfig,
    LineHeads,
    LineOutput,
    LineQueries,
    NoisedLines,
    PointQueries,
    point_position,
)
from tflane_jax.models.parameters import with_equal_heads
from tflane_jax.models.prior import HostQueries, HostSpec, Prior
from tflane_jax.models.priors import ByPrior, fuse_into_queries
from tflane_jax.scene import Example, LineClass, LinePrediction, MapLines, Prediction


@dataclass(frozen=True, kw_only=True)
class MapTrConfig(HostConfig):
    """Configuration of MapTR; without priors, the vision-only baseline.

    Attributes:
        decoder: decoder of map lines.
        denoising: noised lines in training (`models.lane_denoising`), with `decoder.anchors="spread"` only; None as in
            the paper.
        axes: axes in which the host works. "ego": x forward, y left, as everywhere. "lidar": x to the right, y forward,
            as the weights published for nuScenes need it (`models.lidar_axes`); the grid of `encoder` is then given in
            these axes, and all else, the predictions too, stays in the frame of the example.
        encoder, range, priors: see `HostConfig`. MapTR predicts no traffic elements.
    """

    decoder: LineDecoderConfig = LineDecoderConfig()
    denoising: DenoisingConfig | None = None
    axes: Literal["ego", "lidar"] = "ego"

    truth: ClassVar[tuple[str, ...]] = ("map_lines",)
    predicts: ClassVar[tuple[str, ...]] = ("lines",)
    query_type: ClassVar[Literal["instance", "point"]] = "point"

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        return self.decoder.dim

    @property
    def line_classes(self) -> int:
        """Number of classes of map lines that it learns."""
        return self.decoder.classes

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """The denoised lines, and the outputs of every host."""
        return (*(() if self.denoising is None else ("denoised",)), *super().auxiliary)

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        """Lines are compared point by point."""
        predicted = self.decoder.points, "as many as it predicts for a line (task.model.decoder.points)"
        return {"map_lines.points": predicted}

    @property
    def example_forms(self) -> dict[str, tuple[str, str]]:
        """Centerlines are labelled if they are a class."""
        if self.decoder.classes <= LineClass.CENTERLINE:
            return {}
        return {"map_lines.centerlines": ("include", "it learns four classes of lines (task.model.decoder.classes)")}

    @property
    def bev_range(self) -> PerceptionRange:
        """The box that the BEV features cover, in the frame of the example, metres."""
        return self.encoder.bev_range if self.axes == "ego" else range_in_ego_axes(self.encoder.bev_range)

    @property
    def spec(self) -> HostSpec:
        """The properties of the host that priors depend on, in the host's own axes."""
        spec = super().spec
        return spec if self.axes == "ego" else replace(spec, range=range_in_lidar_axes(self.range), forward="y")

    def in_host_frame(self, example: Example) -> Example:
        """Return an example in the host's own axes."""
        return example if self.axes == "ego" else in_lidar_axes(example)

    def lines_over_bev(self, lines: MapLines, example: Example) -> MapLines:
        """Return map lines of the example's frame in that of the raster of line masks, whose range is `bev_range`."""
        return lines if self.axes == "ego" else lines_beside_lidar(lines, example)

    def lines_in_views(self, lines: MapLines, example: Example) -> MapLines:
        """Return map lines of the example's frame as the masks in the images show them, in the same frame."""
        return lines if self.axes == "ego" else lines_below_lidar(lines, example)

    def build_priors(self) -> dict[str, Prior]:
        """Return the priors of this host, by name; they observe examples in the host's own axes."""
        priors = super().build_priors()
        return priors if self.axes == "ego" else {name: InLidarAxes(prior) for name, prior in priors.items()}

    def build(self) -> Host:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return MapTr(self)

    def limits(self) -> Rules:
        """Those of every host, and what MapTR cannot do."""
        yield "elements", self.elements is None, "None: MapTR predicts no traffic elements"
        cells = self.encoder.cells
        yield "encoder.cells", not cells, "False: BEV cells learn directed lanes, which MapTR's truth lacks"
        known = self.denoising is None or self.decoder.anchors == "spread"
        yield "denoising", known, "None, or decoder.anchors spread: queries on noised lines know where their points are"
        if self.axes == "lidar":
            seen = isinstance(self.encoder, CameraEncoderConfig)
            yield "axes", seen, "ego: BEV evidence is a raster in the ego axes"
            yield "denoising", self.denoising is None, "None with axes lidar: noised lines are in the ego axes"
            yield "priors.markers", self.priors.markers is None, "None with axes lidar: markers are in the ego axes"
            laid = "not spread with axes lidar: these anchors lie along x, which is ahead in the ego axes"
            yield "decoder.anchors", self.decoder.anchors != "spread", laid
            bev = getattr(self.encoder, "bev", None)
            turned = isinstance(bev, BevFormerConfig) and bev.memory != "off" and bev.align == "bevformer"
            wanted = "reference or warp: the motion is in the lidar's axes already, and bevformer turns it once more"
            yield "encoder.bev.align", not turned, wanted
        yield from super().limits()


PAPER_RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0), (-2.0, 2.0))
"""60 m along the vehicle's axis and 30 m across it, as the paper has them."""
PAPER_MAP_ENCODER = CameraEncoderConfig(
    replace(PAPER_IMAGE_ENCODER, stages=(3,), pyramid=FeaturePyramidConfig(256, 1)),
    BevFormerConfig(
        BevGrid(PAPER_RANGE, 100, 200), layers=1, levels=1, cameras=6, attention="kernel", initial="normal"
    ),
)


def paper_config() -> MapTrConfig:
    """Return the published sizes (tiny, GKT): ResNet-50, six cameras, 200 x 100 cells, 50 lines of 20 points."""
    return MapTrConfig(encoder=PAPER_MAP_ENCODER, range=PAPER_RANGE, decoder=PAPER_LINE_DECODER, initial="xavier")


class MapTr(Host):
    """From one example to the predictions of every decoder layer."""

    config: MapTrConfig

    @nn.nowrap
    def init(self, *args: Any, **kwargs: Any) -> Any:
        """Return initial variables, as Linen does; the heads of all layers start as copies of the first layer's."""
        return with_equal_heads(super().init(*args, **kwargs), self.config.decoder.layers)

    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        level = None if self.config.axes == "ego" else level_pose(example)
        return self.decode(bev, tokens, example.map_lines, deterministic=deterministic, level=level)

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
        """Return the lines of every decoder layer from BEV features and prior tokens.

        Args:
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            tokens: of the priors, by name.
            lines: ground truth to denoise; not used otherwise.
            deterministic: no dropout.
            level: turns lines from the host's axes into the frame of the example; None: these are the same.
        """
        return turned(self.decode_one_to_one(bev, tokens, lines, deterministic), level)

    def decode_one_to_one(
        self, bev: Float[Array, "h w e"], tokens: ByPrior | None, lines: MapLines | None, deterministic: bool
    ) -> Prediction:
        """Return the predictions of the learned queries, and sow those of noised ones in training; in `decode`."""
        config, range_ = self.config, self.config.spec.bev_range
        start = LineQueries(config.decoder, range_, name="queries")()
        rest = bev, tokens or {}, deterministic
        if config.denoising is None or lines is None or not self.is_mutable_collection(AUXILIARY):
            return self.decode_queries(start, *rest)
        taught = lines.of_classes(config.decoder.classes)
        noised = NoisedLines(config.decoder, config.denoising, range_, name="noised")(taught)
        return decode_groups(self, start, noised, *rest)

    def decode_queries(
        self, start: PointQueries, bev: Float[Array, "h w e"], tokens: ByPrior, deterministic: bool
    ) -> Prediction:
        """Return the predictions of one set of queries.

        Args:
            start: I lines of P points: content and position (I, P, C), points (I, P, D) in [0, 1].
            bev: BEV features.
            tokens: of the priors, by name.
            deterministic: no dropout.
        """
        config, spec = self.config.decoder, self.config.spec
        queries, position, reference = start
        lines, points, dim = queries.shape
        groups, outputs = self.groups(lines), []
        together = points_together = None
        if (same := same_group(groups)) is not None:
            together = jnp.asarray(same)
            points_together = jnp.asarray(np.kron(same, np.ones((points, points), bool)))  # (I P, I P), by point
        sizes = tuple(count * points for count in groups)
        for i in range(config.layers):
            placed = point_position(config, i, position, reference)
            spots = reference.reshape(lines * points, 1, -1)
            flat = HostQueries(queries.reshape(-1, dim), placed.reshape(-1, dim), spots, points_together, sizes)
            queries = fuse_into_queries(self.priors.by_name, tokens, i, flat).reshape(queries.shape)
            queries = self.attend(i, queries, placed, reference, bev, together, deterministic)
            heads = LineHeads(config, spec.bev_range, spec.range, name=f"heads_{i}")
            outputs.append(heads(queries, reference))
            reference = lax.stop_gradient(outputs[-1].unit)
        return make_prediction(outputs)

    def groups(self, lines: int) -> tuple[int, ...]:
        """Return the numbers of lines, of so many in all, in groups that exchange nothing; () for a single group."""
        return ()

    def attend(
        self,
        layer: int,
        queries: Float[Array, "i p c"],
        placed: Float[Array, "i p c"],
        reference: Float[Array, "i p d"],
        bev: Float[Array, "h w e"],
        together: Bool[Array, "i i"] | None,
        deterministic: bool,
    ) -> Float[Array, "i p c"]:
        """Return the queries after a decoder layer: attention among all points, then to the BEV features around each.

        Args:
            layer: its number.
            queries, placed: content of the queries and the position encoding added to it.
            reference: points in [0, 1].
            bev: BEV features.
            together: which line may attend to which; None: all to all.
            deterministic: no dropout.
        """
        config = self.config.decoder
        module = partial(LaneDecoderLayer, config, name=f"layer_{layer}")
        flat = queries.reshape(-1, config.dim), placed.reshape(-1, config.dim), reference[..., :2].reshape(-1, 1, 2)
        return run_layer(self, module, config, *flat, bev, None, deterministic=deterministic).reshape(queries.shape)


def same_group(groups: tuple[int, ...]) -> Bool[np.ndarray, "i i"] | None:
    """Return which of the members of groups, one group after the other, are in the same one; None without groups."""
    if not groups:
        return None
    number = np.repeat(np.arange(len(groups)), groups)
    return number[:, None] == number


def turned(prediction: Prediction, level: Float[Array, "4 4"] | None) -> Prediction:
    """Return a prediction with its lines in the frame of the example; see `MapTr.decode`."""
    if level is None or prediction.lines is None:
        return prediction
    points = lines_in_ego_axes(jnp.asarray(prediction.lines.points), level)
    return replace(prediction, lines=replace(prediction.lines, points=points))


def make_prediction(outputs: list[LineOutput]) -> Prediction:
    """Return lines with a leading axis over decoder layers."""
    layers: LineOutput = jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)
    return Prediction(lines=LinePrediction(layers.points, layers.logits))
