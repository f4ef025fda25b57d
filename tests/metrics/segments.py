"""Frames of lane segments: made by hand, at random, and moved as a whole."""

import dataclasses

import numpy as np

from tests.metrics.cases import straight
from tflane_jax.metrics import LaneDetections, LaneTruth
from tflane_jax.metrics.lane_segment import Flavour, LaneSegmentMetrics
from tflane_jax.metrics.segment_matching import AreaDetections, AreaTruth, SegmentDetections, SegmentTruth


def evaluate(frames, flavour: Flavour = "OpenLane-V2"):
    metrics = LaneSegmentMetrics(flavour)
    for detections, truth in frames:
        metrics.update(detections, truth)
    return metrics.compute()


def segment(y, points=5):
    """Return a 10 m segment along x, 4 m wide, its centerline at `y`."""
    return [straight((0, y + side, 0), (10, y + side, 0), points) for side in (0.0, 2.0, -2.0)]


def frame(true, found, scores, areas=((), ()), found_areas=((), (), ())):
    """Return a frame of segments at the given y."""
    (tc, tl, tr), (fc, fl, fr) = (
        zip(*map(segment, ys), strict=True) if len(ys) else ((), (), ()) for ys in (true, found)
    )
    g, p = len(true), len(found)
    return (
        SegmentDetections(
            LaneDetections(fc, np.array(scores, float), np.zeros((p, p))),
            fl,
            fr,
            AreaDetections(found_areas[0], np.array(found_areas[1], int), np.array(found_areas[2])),
        ),
        SegmentTruth(LaneTruth(tc, np.zeros((g, g), bool)), tl, tr, AreaTruth(areas[0], np.array(areas[1], int))),
    )


def with_types(frame, true, found):
    """Return a frame whose segments have the given pairs of types."""
    detections, truth = frame
    (tl, tr), (fl, fr) = (np.array(pairs).reshape(-1, 2).T for pairs in (true, found))
    return (
        dataclasses.replace(detections, left_type=fl, right_type=fr),
        dataclasses.replace(truth, left_type=tl, right_type=tr),
    )


def random_segments(rng):
    """Return a frame of bent segments with crossings, visibility and types; about half of the detections are near."""
    g, p = int(rng.integers(0, 5)), int(rng.integers(0, 8))

    def bent(near=None):
        start = rng.uniform(-30, 30, 3) * [1, 1, 0.02] if near is None else near + rng.normal(0, 0.5, 3)
        angle = rng.uniform(0, 2 * np.pi) + np.linspace(0, rng.uniform(-1, 1), 10)
        step = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * rng.uniform(0.5, 3)
        center = start + np.cumsum(step, 0)
        left = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1) * 1.8
        return np.stack([center, center + left, center - left])

    true = [bent() for _ in range(g)]
    found = [true[rng.integers(g)] + rng.normal(0, 0.5, 3) if g and rng.random() < 0.6 else bent() for _ in range(p)]
    areas = [rng.uniform(-30, 30, (1, 3)) + rng.uniform(-5, 5, (20, 3)) for _ in range(3)]
    return (
        SegmentDetections(
            LaneDetections([s[0] for s in found], rng.permutation(p) / 10 + 0.05, rng.random((p, p))),
            [s[1] for s in found],
            [s[2] for s in found],
            AreaDetections([a + rng.normal(0, 0.4, 3) for a in areas], np.array([1, 1, 2]), rng.random(3)),
            *rng.integers(0, 3, (2, p)),
        ),
        SegmentTruth(
            LaneTruth([s[0] for s in true], rng.random((g, g)) < 0.3, rng.random(g)),
            [s[1] for s in true],
            [s[2] for s in true],
            AreaTruth(areas, np.array([1, 1, 2])),
            *rng.integers(0, 3, (2, g)),
        ),
    )


def moved(part, matrix, swap=False):
    """Return truth or detections with all points multiplied by a matrix, and left and right exchanged."""

    def turn(lines):
        return [line @ matrix.T for line in lines]

    sides = ("right", "left") if swap else ("left", "right")
    return dataclasses.replace(
        part,
        lanes=dataclasses.replace(part.lanes, points=turn(part.lanes.points)),
        areas=dataclasses.replace(part.areas, points=turn(part.areas.points)),
        left=turn(getattr(part, sides[0])),
        right=turn(getattr(part, sides[1])),
        left_type=getattr(part, f"{sides[0]}_type"),
        right_type=getattr(part, f"{sides[1]}_type"),
    )
