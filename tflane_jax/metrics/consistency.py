"""C-mAP: MapTR's metric over sequences, where a line must be found again as the same line.

After MapTracker (Chen et al., ECCV 2024): confident detections get identities over time, and a true positive whose line
was first matched under another identity counts as false. What that definition leaves open is decided so:

- only detections above `CONFIDENT` take part at all, so that C-mAP is bounded by the AP of these;
- a line is "first matched" at each Chamfer threshold on its own, in the first frame of its scene in which it is a true
  positive there. If several pieces of one line are matched in that frame, the identities of all of them are its own;
- an inconsistent match does not change the identity of the line: a detector that swaps two identities for good stays
  wrong until the end of the scene;
- an identity may belong to several lines (two lines found as one is not an error of consistency);
- centerlines are left out: MapTR's centerlines are paths through the part of the lane graph in range, which are other
  paths in the next frame.

Where identities of detections come from is the caller's, see `evaluation.line_tracks`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.metrics.bootstrap import Weights, bootstrap_precisions, frame_numbers
from tflane_jax.metrics.frames import check_shape
from tflane_jax.metrics.map_matching import CLASSES, MAP_THRESHOLDS, MatchedMap
from tflane_jax.metrics.matching import average_precision_area, pooled
from tflane_jax.metrics.merging import by_frame
from tflane_jax.metrics.vector_map import counted_in_sample, mean_precision

CONFIDENT = 0.4


class MapConsistency:
    """Accumulator of C-mAP; the frames of a scene come in succession."""

    def __init__(self) -> None:
        self._detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, classes, consistent hits
        self._frame_truths: list[np.ndarray] = []  # of every frame: true lines by class
        # Of every threshold, by number of a true line: identities in the first frame that matches it.
        self._first: list[dict[int, set[int]]] = [{} for _ in MAP_THRESHOLDS]

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return f"C-mAP v1 (above {CONFIDENT:g})"

    def start(self) -> None:
        """Start the next scene."""
        self._first = [{} for _ in MAP_THRESHOLDS]

    def add(self, frame: MatchedMap, identities: Int[np.ndarray, " p"], lines: Int[np.ndarray, " g"]) -> None:
        """Add the next frame of the scene.

        Args:
            frame: matching results of the confident detections.
            identities: of these detections.
            lines: numbers of the true lines, the same in every frame of the scene; those of centerlines are not read.

        Raises UserError if a detection or a true line lacks its number.
        """
        identities, lines = np.asarray(identities), np.asarray(lines)
        check_shape(identities, frame.scores.shape, "identities of detections")
        check_shape(lines, (frame.lanes,), "numbers of true lines")
        measured = frame.classes < len(CLASSES)
        frame, identities = frame.detections(measured), identities[measured]
        consistent = np.zeros(frame.hits.shape, bool)
        for row, hits, first in zip(consistent, frame.hits, self._first, strict=True):
            new: dict[int, set[int]] = {}
            for p in np.flatnonzero(hits).tolist():
                line, identity = int(lines[frame.nearest[p]]), int(identities[p])
                if line not in first:
                    new.setdefault(line, set()).add(identity)
                row[p] = line not in first or identity in first[line]
            first |= new
        self._frame_truths.append(frame.truths[: len(CLASSES)])
        self._detections.append((frame.scores, frame.classes, consistent))

    def compute(self) -> dict[str, float]:
        """Return `C-mAP`, the mean over classes of `C-AP_divider` ..., each the mean over MapTR's thresholds."""
        scores, classes, hits = pooled(self._detections, (0,), (len(MAP_THRESHOLDS), 0))
        truths = by_frame(self._frame_truths, (len(CLASSES),), int).sum(0)
        precision = {
            f"C-AP_{name}": np.mean(
                [
                    average_precision_area(scores[classes == c], row[classes == c], int(truths[c]))
                    for row in hits.astype(bool)
                ]
            )
            for c, name in enumerate(CLASSES)
        }
        means = {"C-mAP": np.mean(list(precision.values()))} | precision
        return {name: float(value) for name, value in means.items()}

    def bootstrap(self, weights: Weights) -> dict[str, Float[np.ndarray, " b"]]:
        """Return the numbers of `compute` in samples that count the frames of a scene equally often, see `weights`.

        As in MapTR's mAP, a C-AP that a sample lacks is 0, and does not count in its `C-mAP`.
        """
        scores, classes, hits = pooled(self._detections, (0,), (len(MAP_THRESHOLDS), 0))
        frame, truths = frame_numbers(self._detections), by_frame(self._frame_truths, (len(CLASSES),), int)
        precision = {}
        for c, name in enumerate(CLASSES):
            own = classes == c
            _, area = bootstrap_precisions(scores[own], hits[:, own], frame[own], truths[:, c], weights)
            precision[f"C-AP_{name}"] = area.mean(1)
        counted = counted_in_sample((weights @ truths).T, truths.sum(0)[:, None], "all")
        return {"C-mAP": mean_precision(np.stack(list(precision.values()))[:, None], counted)} | precision
