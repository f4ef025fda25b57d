"""Names of the scores of the lane-graph task: columns of its table, what comparisons test, what a host gives."""

from __future__ import annotations

from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.evaluation.lane_graph import LaneGraphMetrics, Sightings
from tflane_jax.evaluation.lane_groups import LANE_GROUPS
from tflane_jax.evaluation.map_metrics import LineLabel
from tflane_jax.evaluation.results import Evaluation, EvaluationConfig, in_all_versions
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.map_matching import LINE_CLASSES
from tflane_jax.models.host import HostConfig

COLUMNS = (
    "lanes of",
    "seed",
    "OLS",
    "DET_l",
    "DET_t",
    "TOP_ll",
    "TOP_lt",
    "mAP",
    "AP_ls",
    "AP_ped",
    "TOP_lsls",
    "AP_divider",
    "AP_ped_crossing",
    "AP_boundary",
    "AP_centerline",
    "C-mAP",
    "AE_type",
    "AE_dist",
    "OLUS",
    "DET_a",
    "TOP_lste",
    "recall",
    "AP_l",
    "DET_l@1.0",
    "DET_l@2.0",
    "DET_l@3.0",
    "lanes",
    "lines",
    "frames",
)
"""Columns of the evaluation's table."""

COMPARED = (
    "all/OLS",
    "all/DET_t",
    "all/TOP_lt",
    "all/mAP",
    "all/AP_ped",
    "all/AE_type",
    "all/AE_dist",
    *(
        f"{group}/{name}"
        for name in ("DET_l", "TOP_ll", "AP_ls", "TOP_lsls", "recall")
        for group in ("all", "occluded", "clear", *Sightings.groups)
    ),
    *(f"{group}/{name}" for name in ("recall", "AP_l") for group in (*LANE_GROUPS[:2], LANE_GROUPS[-1])),
    *(f"lines/{name}" for name in ("mAP", *(f"AP_{kind}" for kind in LINE_CLASSES), "C-mAP", "recall")),
    *(f"lines {group}/recall" for group in ("occluded", "clear", *LANE_GROUPS[:2], LANE_GROUPS[-1])),
)
"""Scores that a comparison tests."""

SHOWN = in_all_versions((*COMPARED, "all/DET_a", "all/OLUS", "all/TOP_lste", "lines IoU/mAP"))
"""Scores in the table of a comparison: also those of the metrics' second version, and of slow or rare metrics."""


def score_names(model: HostConfig, example: ExampleConfig, config: EvaluationConfig, *, grouped: bool) -> set[str]:
    """Return the names ("group/name") of a host's scores, with those of traffic elements if it predicts them.

    Args:
        model: the host.
        example: what the validation examples hold.
        config: of the evaluation.
        grouped: whether lanes are grouped by evidence and traffic.
    """
    groups = () if example.markers is None else Sightings.groups
    labels: tuple[LineLabel, ...] = ("visibility", "identity") if example.map_lines is not None else ()
    metrics = LaneGraphMetrics(
        config.versions,
        groups,
        model.predicts,
        LANE_GROUPS if grouped else (),
        map_measures=config.map_measures,
        line_labels=labels,
    )
    names = set(Evaluation("", metrics.compute()).scores())
    if "segments" in model.predicts:  # without matched pairs, there are no errors
        names |= {f"{group}/{name}" for group in metrics.compute() for name in ("AE_type", "AE_dist")}
    if "lines" in model.predicts:  # without true lines of a class, a part has no AP of it
        whole = [name.removeprefix("lines") for name in names if name.startswith("lines/") and "/C-" not in name]
        parts = [group for group in metrics.compute() if group.startswith("lines ") and group != "lines IoU"]
        names |= {part + name for part in parts for name in whole}
    if example.map_lines is not None and example.map_lines.centerlines == "include":
        names |= {name.replace("/AP_boundary", "/AP_centerline") for name in names if name.startswith("lines")}
    if "centerlines" in model.predicts:  # without lanes, v1.0 is not defined
        every = ("TOP_ll", *(f"TOP_ll_{version}" for version in config.versions[1:]))
        names |= {f"{group}/{name}" for group in ("all", *groups) for name in every}
    if model.elements is not None:
        attributes = ["DET_t", *(f"DET_t@{i}" for i in range(ATTRIBUTES))]
        if "centerlines" in model.predicts:
            scores = ["OLS", "TOP_lt", *attributes]
            scores += [f"{name}_{version}" for version in config.versions[1:] for name in ("OLS", "TOP_lt")]
            names |= {f"{group}/{name}" for group in ("all", *groups) for name in scores}
        else:
            names |= {f"all/{name}" for name in ("OLUS", "TOP_lste", *attributes)}
    return names
