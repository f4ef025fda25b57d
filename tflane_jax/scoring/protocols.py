"""The protocols of `tflane score`: the files that they read and the metric that they compute."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files import tusimple
from tflane_jax.files.fields import PICKLE_SUFFIXES
from tflane_jax.files.openlane import FrameKey
from tflane_jax.metrics.f_score import CenterlineFScore
from tflane_jax.metrics.groups import GroupedMetrics, LaneMetrics
from tflane_jax.metrics.lane_segment import Flavour, LaneSegmentMetrics
from tflane_jax.metrics.map_matching import LINE_CLASSES, Dims, Measure, Sampling
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.partitions import ByDistance
from tflane_jax.metrics.topology import Version
from tflane_jax.metrics.tusimple import LSTR_TIME_LIMIT, OFFICIAL_TIME_LIMIT, TuSimpleMetrics
from tflane_jax.metrics.vector_map import VectorMapMetrics
from tflane_jax.scoring import maptr, openlane_v2, plain, remarks
from tflane_jax.scoring.recognise import Format, Side, check_there, hint
from tflane_jax.scoring.score import Accumulator, numbers_of


@dataclass(frozen=True)
class ScoringProtocol:
    """One protocol.

    Attributes:
        read_predictions, read_truth: read a path and return the input of the metric by frame. With frames that have a
            split, `read_truth` takes those that are `predicted`.
        scene_of: returns the name of a frame's scene.
        metrics: returns a new accumulator.
        columns: of the table, in this order; the JSON file has them all.
        formats: of the files, for messages.
        groups: by a criterion that partitions lanes, "occlusion" or "distance": returns a new accumulator whose numbers
            are by group.
        of_scene: returns the numbers of the accumulator of one scene, which may lack what the whole has.
        remarks: returns what is unusual, though not wrong, about predictions and truth.
        zero_score: name of the score that is 0 exactly if no predicted line is near a true one; "" for none.
        look_at: what a user should look at then, the end of the remark: axes, units and frame of the lines.
        no_scenes: why `scene_of` separates frames of one drive; "" if it does not.
    """

    read_predictions: Callable[[Path], Mapping[Any, Any]]
    read_truth: Callable[..., Mapping[Any, Any]]
    scene_of: Callable[[Any], str]
    metrics: Callable[[], Accumulator]
    columns: tuple[str, ...]
    formats: tuple[Format, ...]
    groups: Mapping[str, Callable[[], Any]] = field(default_factory=dict)
    of_scene: Callable[[Any], dict[str, Any]] = numbers_of
    remarks: remarks.Remarks = remarks.no_remarks
    zero_score: str = ""
    look_at: str = "x forward, y left, z up, metres in the vehicle's frame"
    no_scenes: str = ""

    def read(self, predictions: Path, truth: Path) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
        """Return the content of both files by frame; raises UserError that names file, frame, field and cause.

        Of OpenLane-V2's folder, the predicted splits and subset are read: the test split has no annotations.
        """
        for path in (predictions, truth):
            check_there(path)
        found = self._read(self.read_predictions, predictions, "predictions")
        predicted = [key for key in found if isinstance(key, FrameKey)]
        read = partial(self.read_truth, predicted=predicted) if predicted and truth.is_dir() else self.read_truth
        return found, self._read(read, truth, "ground truth")

    def _read(self, read: Callable[[Path], Mapping[Any, Any]], path: Path, side: Side) -> Mapping[Any, Any]:
        try:
            frames = read(path)
            if not frames:
                raise UserError(f"{path} is empty: it has no frames")
            return frames
        except UserError as error:
            formats = {name: protocol.formats for name, protocol in PROTOCOLS.items()}
            raise UserError(f"{error}{hint(path, side, self.formats, formats)}") from None


def _plain_or(read_plain: Callable[[Path], Any], read_official: Callable[..., Any]) -> Callable[..., Any]:
    def read(path: Path, **options: Any) -> Any:
        if path.suffix in plain.SUFFIXES:
            return read_plain(path)
        if path.suffix not in PICKLE_SUFFIXES and not path.is_dir():
            raise UserError(f"{path}: expected a .pkl, .json or .npz file; docs/scoring.md says what it holds")
        return read_official(path, **options)

    return read


def _groups(metrics: Callable[[], LaneMetrics]) -> dict[str, Callable[[], GroupedMetrics]]:
    return {
        "occlusion": partial(GroupedMetrics, metrics),
        "distance": partial(GroupedMetrics, metrics, partition=ByDistance()),
    }


def _centerline(version: Version) -> ScoringProtocol:
    metrics = partial(CenterlineMetrics, (version,))
    return ScoringProtocol(
        read_predictions=_plain_or(plain.read_predictions, openlane_v2.read_predictions),
        read_truth=_plain_or(plain.read_truth, openlane_v2.read_truth),
        scene_of=lambda key: key.scene,
        metrics=metrics,
        columns=("OLS", "DET_l", "DET_t", "TOP_ll", "TOP_lt"),
        formats=("OpenLane-V2 centerlines", "plain centerlines"),
        remarks=remarks.centerlines,
        zero_score="recall",
        groups=_groups(metrics),
    )


def _lane_segment(flavour: Flavour, columns: tuple[str, ...]) -> ScoringProtocol:
    metrics = partial(LaneSegmentMetrics, flavour)
    return ScoringProtocol(
        read_predictions=openlane_v2.read_segment_predictions,
        read_truth=partial(openlane_v2.read_segment_truth, flavour=flavour),
        scene_of=lambda key: key.scene,
        metrics=metrics,
        columns=(*columns, "AE_type", "AE_dist"),
        formats=("OpenLane-V2 lane segments",),
        of_scene=lambda metrics: metrics.compute("frames"),
        remarks=remarks.segments,
        zero_score=columns[1],
        groups=_groups(metrics),
    )


def _maptr(sampling: Sampling, measure: Measure = "chamfer", dims: Dims = 2) -> ScoringProtocol:
    metrics = partial(VectorMapMetrics, sampling, measure, dims)
    return ScoringProtocol(
        read_predictions=partial(maptr.read_predictions, dims=dims),
        read_truth=partial(maptr.read_truth, dims=dims),
        scene_of=lambda token: token,
        no_scenes="MapTR's files do not say which drive a sample is of, and single samples are drawn",
        metrics=metrics,
        columns=("mAP", *(f"AP_{name}" for name in LINE_CLASSES)),
        formats=("MapTR",),
        of_scene=lambda metrics: metrics.compute("frames"),
        remarks=remarks.units,
        zero_score="mAP",
        look_at="and are the classes right",
        groups=_groups(metrics),
    )


def _tusimple(time_limit: float) -> ScoringProtocol:
    return ScoringProtocol(
        read_predictions=tusimple.read_predictions,
        read_truth=tusimple.read_truth_once,
        scene_of=lambda image: image.rpartition("/")[0],
        no_scenes=tusimple.NO_DRIVES,
        metrics=partial(TuSimpleMetrics, time_limit),
        columns=("Accuracy", "FP", "FN"),
        formats=("TuSimple",),
        remarks=partial(remarks.images, time_limit=time_limit),
    )


PROTOCOLS: dict[str, ScoringProtocol] = {
    "openlane-v2.1-centerline": _centerline("v2.1"),
    "openlane-v1.0-centerline": _centerline("v1.0"),
    "openlane-v2.1-lane-segment": _lane_segment("OpenLane-V2", ("OLUS", "DET_l", "DET_a", "DET_t", "TOP_ll", "TOP_lt")),
    "lanesegnet": _lane_segment("LaneSegNet", ("mAP", "AP_ls", "AP_ped", "TOP_lsls", "AP_boundary")),
    "openlane-v2-f-score": dataclasses.replace(
        _centerline("v2.1"),
        metrics=CenterlineFScore,
        columns=("F_score", "F_recall", "F_precision"),
        groups={},
        remarks=remarks.units,
        zero_score="F_recall",
    ),
    "maptr": _maptr("maptr"),
    "maptrv2": _maptr("maptrv2"),
    "maptrv2-3d": _maptr("maptrv2", dims=3),
    "maptr-iou": _maptr("maptr", "iou"),
    "maptrv2-iou": _maptr("maptrv2", "iou"),
    "tusimple": _tusimple(OFFICIAL_TIME_LIMIT),
    "tusimple-lstr": _tusimple(LSTR_TIME_LIMIT),
}


def find_protocol(name: str) -> ScoringProtocol:
    """Return a protocol; raises UserError that lists them all where there is none of this name."""
    if name not in PROTOCOLS:
        raise UserError(f"there is no protocol {name!r}, only {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
