"""Padding of every part of an example at once, with all priors: losses and gradients do not change by a bit."""

import dataclasses
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.models.cases import (
    CAMERA_DETR,
    CAMERA_TOPONET,
    SMALL_LINES,
    SMALL_SEGMENTS,
    WITH_TRAFFIC,
    make_bucket_example,
    make_camera_example,
    make_line_example,
    make_segment_example,
)
from tests.models.test_parameters import BUCKET
from tests.parameters import random_params
from tflane_jax.layers.polyline_encoder import PolylineEncoderConfig
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import LaneProposalConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.models.marker_fusion import SMALL_MARKER_FUSION
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.raster_fusion import TrafficRasterConfig
from tflane_jax.models.sd_map_encoder import SMALL_SD_MAP
from tflane_jax.scene import MarkerObservations, SdMap
from tflane_jax.tasks.lane_graph import LaneGraphTask

LINES = PolylineEncoderConfig(dim=8, layers=1, heads=2, hidden=8, dropout=0.0, bands=4)
FLOW = WITH_TRAFFIC.priors.traffic_flow
assert FLOW is not None
PRIORS = PriorsConfig(
    traffic_flow=replace(FLOW, bev=TrafficRasterConfig()),
    sd_map=replace(SMALL_SD_MAP, width=16, lines=LINES),
    markers=replace(SMALL_MARKER_FUSION, width=16, connectivity=True, lines=replace(LINES, attend="points")),
)
NOISE, PROPOSALS = DenoisingConfig(), LaneProposalConfig(count=3, headings=4, hidden=8)
HOSTS = {
    "lanes and elements from cameras": (
        replace(CAMERA_TOPONET, denoising=NOISE),
        TopoNetLossConfig(),
        make_camera_example,
    ),
    "segments": (
        replace(SMALL_SEGMENTS, decoder=replace(SMALL_SEGMENTS.decoder, proposals=PROPOSALS), denoising=NOISE),
        LaneSegNetLossConfig(class_target="quality"),
        make_segment_example,
    ),
    "lines": (replace(SMALL_LINES, denoising=NOISE), MapTrLossConfig(class_target="quality"), make_line_example),
    "control points": (replace(CAMERA_DETR, denoising=NOISE), BevFormerDetrLossConfig(), make_camera_example),
    "segments, areas and elements": (
        BUCKET,
        LaneSegNetLossConfig(),
        make_bucket_example,
    ),
    "lines, one to many": (
        MapTrV2Config(encoder=SMALL_LINES.encoder, decoder=SMALL_LINES.decoder, many=4, line_mask=True),
        MapTrV2LossConfig(many_repeats=2),
        make_line_example,
    ),
}
# Numbers of classes beside floats. The last pair could be real: what only ignores impossible numbers does not pass.
CLASSES = {np.nan: -7, np.inf: 99, -1e30: 99, 15.0: 1}


def with_priors(example):
    """Add two markers of three lanes and two lines of an SD map, each with padding behind."""
    markers, sd_map = MarkerObservations.empty(3, 4, 11), SdMap.empty(4, 11)
    for i in range(2):
        markers.valid[i], markers.lane_valid[i, :3], markers.score[i] = True, True, 0.9
        markers.pose[i, :3, 3], markers.residual[i] = [5.0 + 6.0 * i, 2.0, 1.0], 0.2
        markers.lanes[i, :3], markers.successor[i, 0, 1] = example.lanes.points[:3], True
        sd_map.points[i], sd_map.category[i], sd_map.valid[i] = example.lanes.points[i, :, :2], i, True
    return example.replace(markers=markers, sd_map=sd_map)


def soiled(part, bad, *fields, valid=None):
    """Fill the padding of some fields: floats with `bad`, integers with its class, flags with true."""
    valid = np.asarray(part.valid) if valid is None else valid

    def fill(leaf):
        wrong = {"f": bad, "i": CLASSES[bad], "b": True}[leaf.dtype.kind]
        return np.where(valid.reshape(valid.shape + (1,) * (leaf.ndim - valid.ndim)), leaf, leaf.dtype.type(wrong))

    return replace(part, **{name: fill(getattr(part, name)) for name in fields})


def _lanes(lanes, bad):
    names = [field.name for field in dataclasses.fields(lanes) if field.name not in ("successor", "valid")]
    return soiled(soiled(lanes, bad, *names), bad, "successor", valid=lanes.valid[:, None] & lanes.valid[None])


def dirty(example, bad):
    """Return the example with every padded array full of garbage; there is no previous frame either."""
    flow, markers = example.traffic_flow, example.markers
    flow = soiled(flow, bad, "position", "yaw", "occluded")
    there = markers.lane_valid & markers.valid[:, None]
    markers = soiled(markers, bad, "marker_id", "pose", "score", "residual", "lane_valid")
    markers = soiled(markers, bad, "lanes", valid=there)
    parts = {
        "lanes": _lanes(example.lanes, bad),
        "segments": _lanes(example.segments, bad),
        "areas": soiled(example.areas, bad, "points", "category"),
        "traffic_flow": soiled(flow, bad, "size", "category", valid=example.traffic_flow.valid.any(1)),
        "markers": soiled(markers, bad, "successor", valid=there[:, :, None] & there[:, None]),
        "sd_map": soiled(example.sd_map, bad, "points", "category"),
        "previous_from_ego": np.full((4, 4), bad, np.float32),
    }
    if example.map_lines is not None:
        parts["map_lines"] = soiled(example.map_lines, bad, "points", "category", "closed")
    if example.traffic_elements is not None:
        elements = soiled(example.traffic_elements, bad, "box", "attribute")
        name, graph = ("segment", example.segments) if elements.lane is None else ("lane", example.lanes)
        governs = graph.valid[:, None] & elements.valid[None]
        parts["traffic_elements"] = soiled(elements, bad, name, valid=governs)
    return example.replace(**parts)


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTS)
def test_garbage_in_padding_changes_neither_loss_nor_gradient(name):
    model, losses, make = HOSTS[name]
    task = LaneGraphTask(model=replace(model, priors=PRIORS), losses=losses)
    example = with_priors(make())
    params = random_params(task.init, example, spread=0.1)  # no part is silent, as some are at the start

    @jax.jit
    def learn(params, batch):
        return jax.value_and_grad(lambda p: task.loss(p, batch, jax.random.key(1)), has_aux=True)(params)

    clean, *others = (
        learn(params, jax.tree.map(lambda leaf: np.stack([leaf, leaf]), one))
        for one in (example, *(dirty(example, bad) for bad in CLASSES))
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clean))
    for other in others:
        jax.tree.map(np.testing.assert_array_equal, other, clean)
