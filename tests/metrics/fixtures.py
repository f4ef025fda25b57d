"""Reading golden/metrics/openlanev2_centerline: schema in shared specs/metrics.md section 7."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np

from tests.shared import shared_root
from tflane_jax.metrics import ElementDetections, ElementTruth, LaneDetections, LaneTruth

FOLDER = "golden/metrics/openlanev2_centerline"


@functools.cache
def expected_cases() -> dict[str, dict[str, Any]]:
    """Return what the official evaluator gave, by name of the case; empty where the folder is absent."""
    path = shared_root() / FOLDER / "expected.json"
    return json.loads(path.read_text())["cases"] if path.exists() else {}


def load_frames(name: str) -> list[tuple[LaneDetections, LaneTruth, dict[str, np.ndarray]]]:
    """Return detections, truth and the official intermediate results of each frame of a case."""
    with np.load(shared_root() / FOLDER / "inputs.npz", allow_pickle=False) as file:
        a = {key.split("/", 1)[1]: file[key] for key in file.files if key.split("/", 1)[0] == name}
    frames = range(expected_cases()[name]["n_frames"])

    def rows(field: str, owner: str) -> list[np.ndarray]:
        return [a[field][a[f"{owner}_frame"] == f] for f in frames]

    def lines(side: str) -> list[list[np.ndarray]]:
        counts = a[f"{side}_center_npts"]
        every = np.split(a[f"{side}_center_pts"], np.cumsum(counts)[:-1]) if len(counts) else []
        return [[every[i] for i in np.flatnonzero(a[f"{side}_lane_frame"] == f)] for f in frames]

    def matrices(field: str, heights: list[int], widths: list[int]) -> list[np.ndarray]:
        sizes = np.multiply(heights, widths)
        pieces = np.split(a[field], np.cumsum(sizes)[:-1])
        return [piece.reshape(h, w) for piece, h, w in zip(pieces, heights, widths, strict=True)]

    lanes = {side: lines(side) for side in ("gt", "pd")}
    boxes = {side: rows(f"{side}_te_box", f"{side}_te") for side in ("gt", "pd")}
    attributes = {side: rows(f"{side}_te_attr", f"{side}_te") for side in ("gt", "pd")}
    n = {side: [len(x) for x in lanes[side]] for side in lanes}
    t = {side: [len(x) for x in boxes[side]] for side in boxes}
    ll = {side: matrices(f"{side}_ll", n[side], n[side]) for side in lanes}
    lt = {side: matrices(f"{side}_lt", n[side], t[side]) for side in lanes}
    scores, element_scores = rows("pd_lane_conf", "pd_lane"), rows("pd_te_conf", "pd_te")
    official = {key: rows(key, "pd_lane") for key in a if key.startswith("out_lane_match")}
    official["out_lane_dist"] = matrices("out_lane_dist", n["gt"], n["pd"])

    def frame(f: int) -> tuple[LaneDetections, LaneTruth, dict[str, np.ndarray]]:
        detected = ElementDetections(boxes["pd"][f], attributes["pd"][f], element_scores[f], lt["pd"][f])
        true = ElementTruth(boxes["gt"][f], attributes["gt"][f], lt["gt"][f].astype(bool))
        return (
            LaneDetections(lanes["pd"][f], scores[f], ll["pd"][f], detected),
            LaneTruth(lanes["gt"][f], ll["gt"][f].astype(bool), elements=true),
            {key: values[f] for key, values in official.items()},
        )

    return [frame(f) for f in frames]
