"""Small models and examples for the tests of the models and of training."""

import dataclasses

import numpy as np

from tests.priors.test_traffic_flow import make_flow
from tflane_jax.geometry import BevGrid
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.element_decoder import ElementDecoderConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.image_encoder import ImageEncoderConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.models.lane_segments import SegmentDecoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.lift import LiftConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.scene import (
    Areas,
    AreaType,
    CameraViews,
    Example,
    LaneGraph,
    LineClass,
    MapLines,
    TrafficElements,
)

BASELINE = TopoNetConfig(
    encoder=EvidenceEncoderConfig(dim=16, dilations=(1,)),
    decoder=LaneDecoderConfig(dim=16, heads=2, layers=2, queries=6, points=11, hidden=16, relation=8),
)
WITH_TRAFFIC = dataclasses.replace(
    BASELINE,
    priors=PriorsConfig(
        traffic_flow=TrafficFlowConfig(
            prior=TrafficFlowPriorConfig(max_instances=5),
            module=TrafficFlowModuleConfig(width=8, heads=2, bands=3),
        ),
    ),
)


def make_example(seed: int = 0, instances: int = 9, lanes: int = 4) -> Example:
    """Return an example with a random raster, random tracks and straight lanes."""
    rng = np.random.default_rng(seed)
    graph = LaneGraph.empty(8, 11)
    x = np.linspace(-20, 20, 11)
    for i in range(lanes):
        graph.points[i] = np.stack([x, np.full(11, 4.0 * i - 6.0), np.zeros(11)], -1)
        graph.valid[i] = True
    graph.successor[0, 1] = lanes > 1
    return Example(
        bev=rng.integers(0, 256, (24, 40, 4), dtype=np.uint8),
        hidden=np.zeros((24, 40), bool),
        traffic_flow=make_flow(seed, instances=instances),
        markers=None,
        sd_map=None,
        lanes=graph,
        segments=LaneGraph.empty(2, 10),
        areas=Areas.empty(2, 5),
        traffic_elements=None,
        previous_from_ego=np.eye(4, dtype=np.float32),
        has_previous=np.zeros((), bool),
    )


SEGMENTS = LaneSegNetConfig(
    encoder=BASELINE.encoder,
    decoder=SegmentDecoderConfig(
        dim=16, heads=2, layers=2, queries=6, points=11, sampling_points=4, hidden=16, relation=8
    ),
)
"""LaneSegNet in its published forms."""
SMALL_SEGMENTS = dataclasses.replace(
    SEGMENTS,
    decoder=dataclasses.replace(
        SEGMENTS.decoder, refine="iterative", output="metric", offsets="lane", initial_score=0.01
    ),
    priors=WITH_TRAFFIC.priors,
)
"""LaneSegNet with traffic, in the forms of the small configurations."""


def make_segment_example(seed: int = 0, instances: int = 9, lanes: int = 4, crossings: int = 1) -> Example:
    """Return `make_example` with its lanes as segments 3.5 m wide, and with crossings and a road boundary."""
    example = make_example(seed, instances, lanes)
    across = np.array([0.0, 1.75, 0.0], np.float32)
    graph = example.lanes
    segments = graph.replace(
        left=graph.points + across, right=graph.points - across, left_type=np.where(graph.valid, 1, 0).astype(np.int32)
    )
    areas = Areas.empty(3, 2 * graph.points.shape[1])
    side = np.stack([np.full(11, 8.0), np.linspace(-7, 7, 11), np.zeros(11)], -1)
    half = np.array([1.5, 0.0, 0.0])
    ring = np.concatenate([side - half, side[::-1] + half])
    for i in range(crossings + 1):
        areas.points[i], areas.valid[i] = ring + 6.0 * i, True
        areas.category[i] = AreaType.PEDESTRIAN_CROSSING if i < crossings else AreaType.ROAD_BOUNDARY
    return example.replace(segments=segments, areas=areas)


def make_bucket_example(seed: int = 0, elements: int = 2) -> Example:
    """Return `make_camera_example` with segments, areas, and elements that govern segments."""
    example, segments = make_camera_example(seed, elements=elements), make_segment_example(seed)
    truth = example.traffic_elements
    governing = truth.replace(lane=None, segment=truth.lane)
    return example.replace(segments=segments.segments, areas=segments.areas, traffic_elements=governing)


LINES = MapTrConfig(
    encoder=BASELINE.encoder,
    decoder=LineDecoderConfig(dim=16, heads=2, layers=2, queries=6, points=5, sampling_points=2, hidden=16),
)
"""MapTR in its published forms."""
SMALL_LINES = dataclasses.replace(
    LINES,
    decoder=dataclasses.replace(LINES.decoder, anchors="spread", output="metric", bands=3),
    priors=WITH_TRAFFIC.priors,
)
"""MapTR with traffic, in the forms of the small configurations."""


def make_line_example(seed: int = 0, instances: int = 9, lanes: int = 4, crossings: int = 1) -> Example:
    """Return `make_segment_example` with its lanes as dividers of five points, and crossings as rings."""
    example = make_segment_example(seed, instances, lanes, crossings)
    lines = MapLines.empty(8, 5)
    lines.points[:lanes] = example.lanes.points[:lanes, ::2][:, [0, 1, 2, 3, 5]]
    lines.valid[: lanes + crossings] = True
    for i in range(lanes, lanes + crossings):
        lines.points[i] = [[8, -7, 0], [10, -7, 0], [10, 7, 0], [8, 7, 0], [8, -7, 0]]
        lines.category[i], lines.closed[i] = LineClass.CROSSING, True
    return example.replace(map_lines=lines)


CAMERA = CameraEncoderConfig(
    ImageEncoderConfig(ResNetConfig((1, 1, 1, 1), (4, 4, 8, 8), stem_channels=4), pyramid=FeaturePyramidConfig(16, 2)),
    BevFormerConfig(
        BevGrid(rows=4, columns=6),
        dim=16,
        heads=2,
        layers=1,
        hidden=16,
        dropout=0.1,
        spatial_points=4,
        anchors=2,
        levels=2,
        cameras=2,
    ),
    cells=True,
)
ELEMENTS = ElementDecoderConfig(dim=16, heads=2, layers=2, queries=5, hidden=16, sampling_points=2, dropout=0.1)
CAMERA_TOPONET = dataclasses.replace(
    WITH_TRAFFIC,
    encoder=CAMERA,
    elements=ELEMENTS,
    decoder=dataclasses.replace(BASELINE.decoder, refine="fixed", dropout=0.1),
)
LIFTED_LINES = MapTrV2Config(
    encoder=CameraEncoderConfig(
        dataclasses.replace(CAMERA.images, stages=(3,), pyramid=FeaturePyramidConfig(16, 1)),
        LiftConfig(CAMERA.bev.grid, dim=16, cameras=2, depth=(1.0, 9.0, 1.0), pyramid=4, supervised=True),
        line_masks=True,
    ),
    decoder=SMALL_LINES.decoder,
    many=4,
    line_mask=True,
)
"""MapTRv2 behind two cameras."""
CAMERA_DETR = BevFormerDetrConfig(
    encoder=CAMERA,
    decoder=dataclasses.replace(CAMERA_TOPONET.decoder, points=11),
    elements=ELEMENTS,
    control_points=5,
)


def make_camera_example(seed: int = 0, instances: int = 9, lanes: int = 4, elements: int = 2) -> Example:
    """Return an example with random images of two cameras, to the front and to the back, the second one smaller."""
    rng = np.random.default_rng(seed)
    size = np.array([[96, 64], [80, 48]], np.int32)
    image = rng.integers(0, 256, (2, 64, 96, 3), dtype=np.uint8)
    ahead = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32)
    back = ahead @ np.diag([-1, -1, 1, 1]).astype(np.float32)
    intrinsics = np.array([[[40, 0, w / 2], [0, 40, h / 2], [0, 0, 1]] for w, h in size], np.float32)
    truth = TrafficElements.empty(3, 8)
    for i in range(elements):
        truth.box[i] = [[10.0 + 20 * i, 8.0], [22.0 + 20 * i, 20.0 + i]]
        truth.attribute[i], truth.lane[i, i], truth.valid[i] = 1 + i, True, True
    return make_example(seed, instances, lanes).replace(
        bev=None,
        hidden=None,
        traffic_elements=truth,
        cameras=CameraViews(image, size, intrinsics, np.stack([ahead, back]), np.ones(2, bool)),
    )


def make_depth_example(seed):
    """Return `make_camera_example` with map lines, and with depth in cells of 32 pixels."""
    rng, example = np.random.default_rng(seed), make_camera_example(seed)
    shape = (2, 2, 3)
    depth = rng.uniform(1.0, 9.0, shape).astype(np.float32)
    cameras = example.cameras.replace(depth=depth, depth_valid=rng.random(shape) < 0.7)
    return example.replace(cameras=cameras, map_lines=make_line_example(seed).map_lines)
