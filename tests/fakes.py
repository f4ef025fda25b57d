"""Small made-up examples, predictions and a dataset, for tests that need no world."""

import warnings
from dataclasses import dataclass

import numpy as np

from tflane_jax.datasets.base import FrameInfo, TruncationWarning
from tflane_jax.scene import (
    Areas,
    CameraViews,
    CenterlinePrediction,
    ElementPrediction,
    Example,
    LaneGraph,
    SegmentPrediction,
    TrafficElements,
    TrafficFlow,
)

LANES, POINTS, USERS, FRAMES = 5, 4, 3, 6


def fake_example(seed: int = 0, *, padding: float = 0.0) -> Example:
    """Return an example with two lanes, two road users, one crossing and one light; `padding` fills unused floats."""
    rng = np.random.default_rng([seed, 0])
    lanes = LaneGraph.empty(LANES, POINTS)
    for line in (lanes.points, lanes.left, lanes.right):
        line[:] = padding
        line[:2] = rng.uniform(-20, 20, (2, POINTS, 3))
    lanes.visibility[:] = padding
    lanes.visibility[:2] = 0.25, 1.0
    lanes.valid[:2] = True
    lanes.successor[0, 1] = True
    flow = TrafficFlow.empty(USERS, FRAMES)
    flow.position[:], flow.yaw[:], flow.size[:] = padding, padding, padding
    flow.position[:2, 2:] = rng.uniform(-20, 20, (2, FRAMES - 2, 3))
    flow.yaw[:2, 2:] = rng.uniform(-3, 3, (2, FRAMES - 2))
    flow.size[:2] = 4.5, 2.0, 1.5
    flow.category[:2] = 0, 5
    flow.valid[:2, 2:] = True
    flow.occluded[0, -1] = True
    areas = Areas.empty(2, 5)
    areas.points[:] = padding
    areas.points[0] = [[5, -3, 0], [8, -3, 0], [8, 3, 0], [5, 3, 0], [5, -3, 0]]
    areas.category[0], areas.valid[0] = 1, True
    elements = TrafficElements.empty(2, LANES)
    elements.position[:] = padding
    elements.position[0] = 15.0, 4.0, 5.0
    elements.category[0], elements.attribute[0], elements.valid[0] = 1, 2, True
    hidden = np.zeros((10, 20), bool)
    hidden[3:6, 4:9] = True
    return Example(
        bev=rng.integers(0, 256, (10, 20, 4), dtype=np.uint8),
        hidden=hidden,
        traffic_flow=flow,
        markers=None,
        sd_map=None,
        lanes=lanes,
        segments=LaneGraph.empty(3, POINTS),
        areas=areas,
        traffic_elements=elements,
        previous_from_ego=np.eye(4, dtype=np.float32),
        has_previous=np.asarray(seed % 2 == 1),
    )


def fake_views(seed: int = 0, *, cameras: int = 6, width: int = 48, height: int = 32) -> CameraViews:
    """Return smooth images all round, in an array 16 pixels larger; the first looks ahead, the last is half as high."""
    rng = np.random.default_rng([seed, 2])
    sizes = np.array([[width, height]] * (cameras - 1) + [[width, height // 2]], np.int32)
    images = np.zeros((cameras, height + 16, width + 16, 3), np.uint8)
    for image, (w, h) in zip(images, sizes, strict=True):
        u, v = np.meshgrid(np.linspace(0, 1, w), np.linspace(0, 1, h))
        colour = rng.uniform(40, 120, 3)
        image[:h, :w] = np.stack([colour[0] + 100 * u, colour[1] + 100 * v, colour[2] + 50 * (u + v)], -1)
    yaw = 2 * np.pi * np.arange(cameras) / cameras
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # camera's x, y, z when it looks ahead
    pose = np.tile(np.eye(4, dtype=np.float32), (cameras, 1, 1))
    for i, angle in enumerate(yaw):
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose[i, :3, :3] = axes @ turn
        pose[i, :3, 3] = -pose[i, :3, :3] @ [1.5, 0.0, 1.6]
    focal = rng.uniform(30, 40, cameras)
    intrinsics = np.zeros((cameras, 3, 3), np.float32)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal
    intrinsics[:, :2, 2] = sizes / 2
    intrinsics[:, 2, 2] = 1.0
    return CameraViews(images, sizes, intrinsics, pose, np.ones(cameras, bool))


def empty_example() -> Example:
    """Return an example of the same shapes in which nothing is valid."""
    example = fake_example()
    parts = {name: getattr(example, name) for name in ("lanes", "areas", "traffic_flow", "traffic_elements")}
    return example.replace(
        bev=np.zeros_like(example.bev),
        hidden=np.zeros_like(example.hidden),
        **{name: part.replace(valid=np.zeros_like(part.valid)) for name, part in parts.items()},
    )


def fake_prediction(seed: int = 0, *, queries: int = 6) -> CenterlinePrediction:
    """Return a prediction with two confident, connected lanes; the others have low scores."""
    rng = np.random.default_rng([seed, 1])
    logits = np.full((queries, 1), -4.0, np.float32)
    logits[:2] = 2.0
    links = np.full((queries, queries), -3.0, np.float32)
    links[:1, 1:2] = 3.0
    return CenterlinePrediction(rng.uniform(-20, 20, (queries, POINTS, 3)).astype(np.float32), logits, links)


def fake_segments(seed: int = 0, *, queries: int = 6) -> SegmentPrediction:
    """Return two confident, connected segments with types, one confident crossing, and queries of low scores."""
    rng = np.random.default_rng([seed, 4])
    logits = np.full((queries, 2), -4.0, np.float32)
    logits[:2, 0] = logits[2:3, 1] = 2.0
    links = np.full((queries, queries), -3.0, np.float32)
    links[:1, 1:2] = 3.0
    points = rng.uniform(-20, 20, (queries, POINTS, 3)).astype(np.float32)
    across = np.array([0.0, 1.8, 0.0], np.float32)
    types = np.full((2, queries, 3), -2.0, np.float32)
    types[0, [0, 1], [1, 2]] = types[1, [0, 1], [0, 1]] = 2.0
    return SegmentPrediction(points, points + across, points - across, logits, *types, successor_logits=links)


def fake_elements(seed: int = 0, *, elements: int = 3, queries: int = 6) -> ElementPrediction:
    """Return a green light that governs the first two lanes, and two elements of low score."""
    rng = np.random.default_rng([seed, 2])
    corner = rng.uniform(0, 50, (elements, 1, 2))
    box = np.concatenate([corner, corner + rng.uniform(5, 20, (elements, 1, 2))], 1).astype(np.float32)
    logits = rng.uniform(-5, -4, (elements, 13)).astype(np.float32)
    logits[1, 2] = 2.0
    governs = np.full((queries, elements), -3.0, np.float32)
    governs[:2, 1] = 3.0
    return ElementPrediction(box, logits, governs)


@dataclass(frozen=True)
class FakeConfig:
    """How many examples, and one number that changes all of them."""

    size: int = 3
    seed: int = 0


class FakeDataset:
    """A dataset of fake examples that can be sent to worker processes."""

    def __init__(self, config: FakeConfig):
        self.config = config
        self.name = "fake"

    def __len__(self) -> int:
        return self.config.size

    def example(self, index: int) -> Example:
        return fake_example(1000 * self.config.seed + index)

    def info(self, index: int) -> FrameInfo:
        pose = np.eye(4) * (1 + 1 / 3)
        return FrameInfo("fake", f"scene {index // 2}", timestamp_ns=10**18 + index, global_from_ego=pose)


class CrowdedDataset(FakeDataset):
    """Warns at every example but the first."""

    def example(self, index: int) -> Example:
        if index > 0:
            warnings.warn("more lanes than room", TruncationWarning, stacklevel=2)
        return super().example(index)


class BrokenDataset(FakeDataset):
    """Fails at its third example."""

    def example(self, index: int) -> Example:
        if index == 2:
            raise RuntimeError("broken")
        return super().example(index)


class DeadlyDataset(FakeDataset):
    """Kills the process that makes its last example, as the kernel does when memory runs out."""

    def example(self, index: int) -> Example:
        if index == len(self) - 1:
            import os

            os._exit(9)
        return super().example(index)


class UnevenDataset(FakeDataset):
    """Has examples of different shapes."""

    def example(self, index: int) -> Example:
        example = super().example(index)
        return example if index == 0 else example.replace(bev=example.bev[1:])
