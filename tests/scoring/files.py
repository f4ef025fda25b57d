"""Official files written from the metrics' own containers."""

import pickle
from typing import Any

import numpy as np

from tflane_jax.metrics import LaneDetections, LaneTruth

FRAMES = [("val", "10000", "100"), ("val", "10000", "150"), ("val", "10001", "100")]


def centerline_annotation(truth: LaneTruth) -> dict[str, Any]:
    """Return the annotation of an OpenLane-V2 frame, as plain lists."""
    assert truth.elements is not None
    elements = zip(truth.elements.boxes, truth.elements.attributes, strict=True)
    return {
        "lane_centerline": [{"id": str(i), "points": np.asarray(p).tolist()} for i, p in enumerate(truth.points)],
        "traffic_element": [
            {"id": str(i), "points": b.tolist(), "attribute": int(a)} for i, (b, a) in enumerate(elements)
        ],
        "topology_lclc": truth.successor.astype(int).tolist(),
        "topology_lcte": truth.elements.lane.astype(int).tolist(),
    }


def centerline_prediction(detections: LaneDetections) -> dict[str, Any]:
    """Return the predictions of an OpenLane-V2 frame, arrays as TopoNet writes them."""
    found = detections.elements
    assert found is not None
    elements = zip(found.boxes, found.attributes, found.scores, strict=True)
    lanes = zip(detections.points, detections.scores, strict=True)
    return {
        "lane_centerline": [{"id": i, "points": np.array(p), "confidence": c} for i, (p, c) in enumerate(lanes)],
        "traffic_element": [
            {"id": i, "points": b, "attribute": a, "confidence": c} for i, (b, a, c) in enumerate(elements)
        ],
        "topology_lclc": detections.successor,
        "topology_lcte": found.lane,
    }


def write_submission(path, frames: dict[tuple[str, str, str], LaneDetections], change=lambda results: None) -> None:
    """Write a submission; `change` may damage it before."""
    results = {key: {"predictions": centerline_prediction(detections)} for key, detections in frames.items()}
    change(results)
    path.write_bytes(pickle.dumps({"method": "test", "authors": ["nobody"], "results": results}))


def write_collection(path, frames: dict[tuple[str, str, str], LaneTruth], change=lambda frames: None) -> None:
    """Write a collected annotation file; `change` may damage it before."""
    collected = {key: {"annotation": centerline_annotation(truth)} for key, truth in frames.items()}
    change(collected)
    path.write_bytes(pickle.dumps(collected))
