"""Reading the golden cases of OpenLane-V2 (both tasks) and MapTR: schema in docs/reference/golden.md."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from tests.shared import shared_root
from tflane_jax.metrics import ElementDetections, ElementTruth, LaneDetections, LaneTruth
from tflane_jax.metrics.map_matching import CLASSES, MapDetections, MapTruth
from tflane_jax.metrics.segment_matching import AreaDetections, AreaTruth, SegmentDetections, SegmentTruth

Task = Literal["centerline", "lanesegment", "maptr"]
Arrays = dict[str, np.ndarray]


def folder(task: Task):
    """Return where the cases of a task are."""
    return shared_root() / "golden" / "metrics" / ("maptr" if task == "maptr" else f"openlanev2_{task}")


@functools.cache
def expected_cases(task: Task = "centerline") -> dict[str, dict[str, Any]]:
    """Return what the official evaluator gave, by name of the case; empty where the folder is absent."""
    path = folder(task) / "expected.json"
    return json.loads(path.read_text())["cases"] if path.exists() else {}


def load_frames(name: str) -> list[tuple[LaneDetections, LaneTruth, Arrays]]:
    """Return detections, truth and the official intermediate results of each frame of a centerline case."""
    case = _Case("centerline", name)
    return list(zip(*case.lanes(), case.official(), strict=True))


def load_segments(name: str) -> list[tuple[SegmentDetections, SegmentTruth, Arrays]]:
    """Return the same of a lane-segment case."""
    case = _Case("lanesegment", name)
    detections, truths = case.lanes()
    sides = {
        (who, which): case.lines(f"{who}_{which}", f"{who}_lane") for who in ("gt", "pd") for which in ("left", "right")
    }
    areas = {who: case.lines(f"{who}_area", f"{who}_area") for who in ("gt", "pd")}
    categories = {who: case.rows(f"{who}_area_cat", f"{who}_area") for who in ("gt", "pd")}
    scores = case.rows("pd_area_conf", "pd_area")
    return [
        (
            SegmentDetections(
                detection,
                sides["pd", "left"][f],
                sides["pd", "right"][f],
                AreaDetections(areas["pd"][f], categories["pd"][f], scores[f]),
            ),
            SegmentTruth(
                truth, sides["gt", "left"][f], sides["gt", "right"][f], AreaTruth(areas["gt"][f], categories["gt"][f])
            ),
            official,
        )
        for f, (detection, truth, official) in enumerate(zip(detections, truths, case.official(), strict=True))
    ]


def load_maps(name: str) -> list[tuple[MapDetections, MapTruth, list[Arrays]]]:
    """Return the same of a MapTR case; the official results by class: `score` (P, G) and `hits` (3, P)."""
    case = _Case("maptr", name)
    lines = {who: case.lines(who, who) for who in ("gt", "pd")}
    classes = {who: case.rows(f"{who}_cls", who) for who in ("gt", "pd")}
    confidence = case.rows("pd_conf", "pd")
    heights, widths = case.arrays["out_score_shape"].T.tolist()
    scores = case.matrices("out_score", heights, widths)
    hits = np.split(case.arrays["out_tp"].T.astype(bool), np.cumsum(heights)[:-1], 1)
    official = [{"score": score, "hits": hit} for score, hit in zip(scores, hits, strict=True)]  # class-major
    return [
        (
            MapDetections(lines["pd"][f], classes["pd"][f], confidence[f]),
            MapTruth(lines["gt"][f], classes["gt"][f]),
            [official[c * len(case.frames) + f] for c in range(len(CLASSES))],
        )
        for f in case.frames
    ]


class _Case:
    """The arrays of one case, split by frame."""

    def __init__(self, task: Task, name: str) -> None:
        with np.load(folder(task) / "inputs.npz", allow_pickle=False) as file:
            self.arrays = {key.split("/", 1)[1]: file[key] for key in file.files if key.split("/", 1)[0] == name}
        self.frames = range(expected_cases(task)[name]["n_frames"])

    def rows(self, field: str, owner: str) -> list[np.ndarray]:
        return [self.arrays[field][self.arrays[f"{owner}_frame"] == f] for f in self.frames]

    def lines(self, field: str, owner: str) -> list[list[np.ndarray]]:
        counts = self.arrays[f"{field}_npts"]
        every = np.split(self.arrays[f"{field}_pts"], np.cumsum(counts)[:-1]) if len(counts) else []
        frame = self.arrays[f"{owner}_frame"]
        return [[every[i] for i in np.flatnonzero(frame == f)] for f in self.frames]

    def matrices(self, field: str, heights: Sequence[int], widths: Sequence[int]) -> list[np.ndarray]:
        pieces = np.split(self.arrays[field], np.cumsum(np.multiply(heights, widths))[:-1])
        return [piece.reshape(h, w) for piece, h, w in zip(pieces, heights, widths, strict=True)]

    def count(self, owner: str) -> list[int]:
        frame = self.arrays[f"{owner}_frame"]
        return [int((frame == f).sum()) for f in self.frames]

    def lanes(self) -> tuple[list[LaneDetections], list[LaneTruth]]:
        """Return centerlines, topology and traffic elements of every frame."""
        n, t = ({who: self.count(f"{who}_{what}") for who in ("gt", "pd")} for what in ("lane", "te"))
        points = {who: self.lines(f"{who}_center", f"{who}_lane") for who in n}
        ll = {who: self.matrices(f"{who}_ll", n[who], n[who]) for who in n}
        lt = {who: self.matrices(f"{who}_lt", n[who], t[who]) for who in n}
        boxes = {who: self.rows(f"{who}_te_box", f"{who}_te") for who in n}
        attributes = {who: self.rows(f"{who}_te_attr", f"{who}_te") for who in n}
        scores, element_scores = self.rows("pd_lane_conf", "pd_lane"), self.rows("pd_te_conf", "pd_te")
        detections = [
            LaneDetections(
                points["pd"][f],
                scores[f],
                ll["pd"][f],
                ElementDetections(boxes["pd"][f], attributes["pd"][f], element_scores[f], lt["pd"][f]),
            )
            for f in self.frames
        ]
        truths = [
            LaneTruth(
                points["gt"][f],
                ll["gt"][f].astype(bool),
                elements=ElementTruth(boxes["gt"][f], attributes["gt"][f], lt["gt"][f].astype(bool)),
            )
            for f in self.frames
        ]
        return detections, truths

    def official(self) -> list[Arrays]:
        """Return the official matches and distances of every frame."""
        matches = {key: self.rows(key, "pd_lane") for key in self.arrays if key.startswith("out_lane_match")}
        for what in ("lane", "te", "area"):
            if f"out_{what}_dist" in self.arrays:
                sizes = self.count(f"gt_{what}"), self.count(f"pd_{what}")
                matches[f"out_{what}_dist"] = self.matrices(f"out_{what}_dist", *sizes)
        return [{key: values[f] for key, values in matches.items()} for f in self.frames]
