"""The protocols that `tflane score` knows: which files they read and which metric they feed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.tusimple import LSTR_TIME_LIMIT, OFFICIAL_TIME_LIMIT, TuSimpleMetrics
from tflane_jax.scoring import openlane_v2, tusimple
from tflane_jax.scoring.score import Accumulator


@dataclass(frozen=True)
class ScoringProtocol:
    """One protocol.

    Attributes:
        read_predictions, read_truth: from a path to what the metric compares, by frame.
        scene_of: from a frame to the name of its scene.
        metrics: returns a fresh accumulator.
        columns: of its table, in this order; others stay in the JSON file.
    """

    read_predictions: Callable[[Path], Mapping[Any, Any]]
    read_truth: Callable[[Path], Mapping[Any, Any]]
    scene_of: Callable[[Any], str]
    metrics: Callable[[], Accumulator]
    columns: tuple[str, ...]


PROTOCOLS: dict[str, ScoringProtocol] = {
    f"openlane-{version}-centerline": ScoringProtocol(
        read_predictions=openlane_v2.read_predictions,
        read_truth=openlane_v2.read_truth,
        scene_of=lambda key: key.scene,
        metrics=partial(CenterlineMetrics, version),
        columns=("OLS", "DET_l", "DET_t", "TOP_ll", "TOP_lt"),
    )
    for version in ("v2.1", "v1.0")
}

PROTOCOLS |= {
    name: ScoringProtocol(
        read_predictions=tusimple.read_predictions,
        read_truth=tusimple.read_truth,
        scene_of=lambda image: image.rpartition("/")[0],
        metrics=partial(TuSimpleMetrics, limit),
        columns=("Accuracy", "FP", "FN"),
    )
    for name, limit in (("tusimple", OFFICIAL_TIME_LIMIT), ("tusimple-lstr", LSTR_TIME_LIMIT))
}


def find_protocol(name: str) -> ScoringProtocol:
    """Return a protocol; raises UserError that lists them all where there is none of this name."""
    if name not in PROTOCOLS:
        raise UserError(f"there is no protocol {name!r}, only {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
