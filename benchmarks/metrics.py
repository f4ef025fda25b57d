"""Frames per second of the metrics, and the speed-up over the official evaluators.

    python -m benchmarks.metrics --out runs/bench

One process. CPU time, because wall time depends on the load of the machine. Frames are random but realistic: curved
lanes around the ego, each detected half a metre off with a high score; of the remaining detections, with low scores,
half lie some metres from a true lane, as the queries of a transformer do, and half anywhere. The official times are
quoted from docs/reference/metrics.md, section 7 (CPU time, a comparable machine of two cores).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.metrics import (
    AreaDetections,
    AreaTruth,
    CenterlineFScore,
    CenterlineMetrics,
    ElementDetections,
    ElementTruth,
    LaneDetections,
    LaneSegmentMetrics,
    LaneTruth,
    MapDetections,
    MapTruth,
    RowLanes,
    SegmentDetections,
    SegmentTruth,
    TuSimpleMetrics,
    VectorMapMetrics,
)

LANES, ELEMENTS, AREAS = 30, 5, 10  # true ones in a frame
MAP_LINES = (10, 3, 10)  # true dividers, crossings, boundaries


class Comparison(NamedTuple):
    """A protocol at one size.

    Attributes:
        name: of the protocol.
        detections: in a frame.
        frame: returns a random frame.
        metrics: return fresh accumulators, all of which see every frame.
        official_ms: CPU time of the official evaluator for a frame.
        goal: how many times as fast ours is to be.
    """

    name: str
    detections: int
    frame: Callable[[np.random.Generator, int], tuple[Any, Any]]
    metrics: Sequence[Callable[[], Any]]
    official_ms: float
    goal: float


def comparisons() -> list[Comparison]:
    """Return what is measured, with the official times."""
    both, segments = [CenterlineMetrics, CenterlineFScore], [LaneSegmentMetrics]
    lanesegnet, as_given = [lambda: LaneSegmentMetrics("LaneSegNet")], [lambda: VectorMapMetrics("as_given")]
    return [
        *(
            Comparison("OpenLane-V2 centerline, F-score", p, centerlines, both, ms, 50)
            for p, ms in ((50, 119.0), (100, 195.0), (200, 435.0))
        ),
        # The official program always computes the F-score; these are its times less that.
        *(
            Comparison("OpenLane-V2 centerline", p, centerlines, both[:1], ms, 50)
            for p, ms in ((50, 87.0), (100, 134.0), (200, 298.0))
        ),
        *(
            Comparison("OpenLane-V2 lane segments", p, lane_segments, segments, ms, 50)
            for p, ms in ((50, 84.0), (100, 141.0), (200, 231.0))
        ),
        *(
            Comparison("LaneSegNet", p, lane_segments, lanesegnet, ms, 50)
            for p, ms in ((50, 72.0), (100, 122.0), (200, 221.0))
        ),
        *(Comparison("MapTR", p, vector_map, [VectorMapMetrics], ms, 50) for p, ms in ((50, 259.0), (100, 428.0))),
        *(Comparison("MapTR, not resampled", p, vector_map, as_given, ms, 50) for p, ms in ((50, 93.0), (100, 133.0))),
        Comparison("TuSimple", 5, image_lanes, [TuSimpleMetrics], 1.27, 5),
    ]


def curves(rng: np.random.Generator, count: int, points: int) -> Float[np.ndarray, "l n 3"]:
    """Return curved lines of 10 to 40 m within about 50 m ahead and behind and 25 m to the sides."""
    length, bend = rng.uniform(10, 40, (count, 1)), rng.normal(0, 0.02, (count, 1))
    along = np.linspace(0, 1, points) * length
    # Most lanes follow the road, some cross it.
    heading = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2], (count, 1), p=[0.4, 0.15, 0.3, 0.15]) + bend * along
    step = np.stack([np.cos(heading), np.sin(heading), 0.02 * np.ones_like(heading)], -1) * length[..., None] / points
    middle = rng.uniform((-50, -25, -1), (50, 25, 1), (count, 1, 3))
    line = np.cumsum(step, 1)
    return (middle + line - line.mean(1, keepdims=True)).astype(np.float32)


def detected(
    rng: np.random.Generator, true: Float[np.ndarray, "g n d"], others: Float[np.ndarray, "q n d"]
) -> tuple[Float[np.ndarray, "p n d"], Float[np.ndarray, " p"]]:
    """Return detections of all true lines, half a metre off, and the others (half of them moved to a true line)."""

    def near(lines: np.ndarray, spread: float) -> np.ndarray:
        return lines + rng.normal(0, spread, (len(lines), 1, true.shape[-1])) + rng.normal(0, 0.1, lines.shape)

    found, others = near(true, 0.4), others.copy()
    others[::2] = near(true[rng.integers(0, len(true), len(others[::2]))], 2.0)
    scores = np.concatenate([rng.uniform(0.3, 0.95, len(true)), rng.uniform(0.0, 0.3, len(others))])
    return np.concatenate([found, others]).astype(np.float32), scores.astype(np.float32)


def edges(rng: np.random.Generator, true: np.ndarray, rows: int, columns: int) -> Float[np.ndarray, "p u"]:
    """Return confidences of edges: mostly low, high between the detections of joined truths."""
    confidence = rng.uniform(0.0, 0.55, (rows, columns)).astype(np.float32)
    g, t = true.shape
    confidence[:g, :t] = np.where(true, rng.uniform(0.4, 1.0, true.shape), confidence[:g, :t])
    return confidence


def centerlines(rng: np.random.Generator, detections: int, points: int = 11) -> tuple[LaneDetections, LaneTruth]:
    """Return a frame of lanes and traffic elements, half as many detections of these as of lanes."""
    true = curves(rng, LANES, points)
    found, scores = detected(rng, true, curves(rng, detections - LANES, points))
    joined, governed = rng.random((LANES, LANES)) < 1.3 / LANES, rng.random((LANES, ELEMENTS)) < 0.2
    corner = rng.uniform(0, 1000, (ELEMENTS, 2))
    boxes = np.stack([corner, corner + rng.uniform(20, 80, (ELEMENTS, 2))], 1)
    attributes = rng.integers(0, 13, ELEMENTS)
    elements = detections // 2
    spread = rng.uniform(0, 1000, (elements - ELEMENTS, 1, 2)) + np.array([[0, 0], [50, 50]])
    found_elements = ElementDetections(
        boxes=np.concatenate([boxes + rng.normal(0, 3, boxes.shape), spread]),
        attributes=np.concatenate([attributes, rng.integers(0, 13, len(spread))]),
        scores=rng.random(elements),
        lane=edges(rng, governed, detections, elements),
    )
    return (
        LaneDetections(found, scores, edges(rng, joined, detections, detections), found_elements),
        LaneTruth(true, joined, elements=ElementTruth(boxes, attributes, governed)),
    )


def lane_segments(rng: np.random.Generator, detections: int) -> tuple[SegmentDetections, SegmentTruth]:
    """Return a frame of lane segments, 3.5 m wide, and areas."""
    found, true = centerlines(rng, detections, points=10)
    aside = np.array([0.0, 1.75, 0.0], np.float32)
    areas = curves(rng, AREAS, 20)
    found_areas, scores = detected(rng, areas, curves(rng, AREAS // 2, 20))
    categories = np.arange(AREAS + AREAS // 2) % 2 + 1
    return (
        SegmentDetections(
            found, found.points + aside, found.points - aside, AreaDetections(found_areas, categories, scores)
        ),
        SegmentTruth(true, true.points + aside, true.points - aside, AreaTruth(areas, categories[:AREAS])),
    )


def vector_map(rng: np.random.Generator, detections: int) -> tuple[MapDetections, MapTruth]:
    """Return a frame of dividers, crossings and boundaries of 20 points, in MapTR's range."""
    classes = np.repeat([0, 1, 2], MAP_LINES)
    true = curves(rng, len(classes), 20)[..., :2] * [0.6, 0.6]
    others = curves(rng, detections - len(classes), 20)[..., :2] * [0.6, 0.6]
    found, scores = detected(rng, true, others)
    found_classes = np.concatenate([classes, rng.integers(0, 3, len(others))])
    return MapDetections(found, found_classes, scores), MapTruth(true, classes)


def image_lanes(rng: np.random.Generator, detections: int) -> tuple[RowLanes, RowLanes]:
    """Return an image of four or five lanes on 56 rows, as many of them detected."""
    rows = np.arange(160.0, 720.0, 10.0)
    slopes = rng.uniform(-2, 2, (int(rng.integers(detections - 1, detections + 1)), 1))
    true = np.where(rows < 240, -2.0, np.round(640 + slopes * (rows - 200)))
    found = np.where(rows < 260, -2.0, true + rng.normal(0, 5, true.shape))
    return RowLanes(found, run_time=10.0), RowLanes(true, rows)


def milliseconds(comparison: Comparison, frames: int, rounds: int) -> list[float]:
    """Return the CPU time of a frame, the final computation shared out among the frames, for each round."""
    rng = np.random.default_rng(0)
    data = [comparison.frame(rng, comparison.detections) for _ in range(frames)]
    times = []
    for _ in range(rounds + 1):
        start = time.process_time()
        accumulators = [make() for make in comparison.metrics]
        for accumulator in accumulators:
            for frame in data:
                accumulator.update(*frame)
            accumulator.compute()
        times.append((time.process_time() - start) / frames * 1e3)
    return times[1:]  # the first touches fresh memory


def run(out: Path, frames: int = 100, rounds: int = 5) -> dict[str, Any]:
    """Measure everything, print the table, write `metrics.json` and `metrics.md` into `out`, and return the record."""
    results = []
    for comparison in comparisons():
        times = milliseconds(comparison, frames, rounds)
        ms = float(np.median(times))
        results.append(
            {
                "protocol": comparison.name,
                "detections": comparison.detections,
                "ms": ms,
                "least_ms": min(times),
                "frames_per_second": 1e3 / ms,
                "official_ms": comparison.official_ms,
                "ratio": comparison.official_ms / ms,
                "goal": comparison.goal,
            }
        )
    table = markdown_table(
        ["protocol", "detections", "ms a frame", "frames/s", "official ms", "times as fast", "goal"],
        [
            [
                r["protocol"],
                str(r["detections"]),
                f"{r['ms']:.2f}",
                f"{r['frames_per_second']:.0f}",
                f"{r['official_ms']:g}",
                f"{r['ratio']:.0f}",
                f"{r['goal']:g}",
            ]
            for r in results
        ],
    )
    table += "\n\nCPU time, one process. The official times are quoted, from a comparable machine of two cores."
    print(table)
    record = {"machine": machine(), "frames": frames, "rounds": rounds, "results": results}
    save(out, "metrics", record, table)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, rounds=5)
    parser.add_argument("--frames", type=int, default=100, help="in each set")
    options = parser.parse_args()
    run(options.out, options.frames, options.rounds)


if __name__ == "__main__":
    main()
