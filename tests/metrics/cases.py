"""A tiny frame whose metrics are worked out by hand, and random frames."""

import dataclasses

import numpy as np

from tflane_jax.metrics import ElementDetections, ElementTruth, LaneDetections, LaneTruth


def straight(start, stop, points=11):
    return np.linspace(start, stop, points)


def hand_frame() -> tuple[LaneDetections, LaneTruth]:
    """Return lanes A -> B ahead of each other and C beside A, with four detections.

    Relaxation: A 1 (it touches the ego), B 0.95 (10 m away), C 0.98 (4 m away).
    Detections, best first: A 0.5 m aside; B 2 m above (1.9 m after relaxation); A again; C reversed (9.8 m).
    """
    truth = LaneTruth(
        points=np.stack(
            [
                straight((0, 0, 0), (10, 0, 0)),
                straight((10, 0, 0), (20, 0, 0)),
                straight((0, 4, 0), (10, 4, 0)),
            ]
        ),
        successor=np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]], bool),
        visibility=np.array([1.0, 0.2, 0.4]),
        elements=ElementTruth(
            boxes=np.array([[[0, 0], [10, 10]]]), attributes=np.array([2]), lane=np.array([[1], [0], [0]], bool)
        ),
    )
    successor = np.zeros((4, 4))
    successor[0, 1], successor[0, 0] = 0.8, 0.6
    lane = np.zeros((4, 2))
    lane[0, 1] = 0.7
    detections = LaneDetections(
        points=np.stack(
            [
                straight((0, 0.5, 0), (10, 0.5, 0)),
                straight((10, 0, 2), (20, 0, 2)),
                straight((0, 0.2, 0), (10, 0.2, 0)),
                straight((10, 4, 0), (0, 4, 0)),
            ]
        ),
        scores=np.array([0.9, 0.8, 0.7, 0.6]),
        successor=successor,
        elements=ElementDetections(
            boxes=np.tile([[[0, 0], [10, 10]]], (2, 1, 1)),
            attributes=np.array([2, 5]),
            scores=np.array([0.5, 0.9]),
            lane=lane,
        ),
    )
    return detections, truth


def random_frame(seed: int, lanes: int = 6, detections: int = 12) -> tuple[LaneDetections, LaneTruth]:
    """Return ragged lanes within 40 m and detections about half of which lie near a lane."""
    rng = np.random.default_rng(seed)

    def line(near=None):
        offset = rng.uniform(-40, 40, 3) * [1, 1, 0.02] if near is None else near + rng.normal(size=3) * [1, 1, 0.2]
        return offset + np.linspace(0, 1, rng.integers(2, 14))[:, None] * rng.uniform(5, 25, 3) * [1, 0.3, 0]

    points = [line() for _ in range(lanes)]
    found = [line(points[rng.integers(lanes)][0] if lanes and rng.random() < 0.5 else None) for _ in range(detections)]
    return (
        LaneDetections(found, rng.permutation(detections) / max(detections, 1), rng.random((detections, detections))),
        LaneTruth(points, rng.random((lanes, lanes)) < 0.3, rng.random(lanes)),
    )


def reordered(detections: LaneDetections, order) -> LaneDetections:
    """Return the same detections of lanes in another order."""
    return dataclasses.replace(
        detections,
        points=[detections.points[i] for i in order],
        scores=detections.scores[order],
        successor=detections.successor[np.ix_(order, order)],
    )
