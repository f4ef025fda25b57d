"""The confidence of Eq. (2) against the error of simulated marker detections.

    python -m benchmarks.marker_confidence --scenes 40

The test split of `configs/markers/` with the paper's simulation, against the same frames without noise. The error of
a detection is the mean displacement of the ground from 10 m behind to 30 m ahead of the vehicle. The other columns say
by how much the detection's own lanes enter Eq. (3) in the rows of Table II: the weight of their tokens times c.

A second table counts the frames in which lanes, seen or remembered, enter Eq. (3) at all. A board that hard masking
ignores still keeps memory from being read; with epsilon at the threshold of the mask, 0.5, it does not.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import jax
import numpy as np

from benchmarks.timing import command_line, markdown_table
from tflane_jax.config import load_config
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.geometry import PerceptionRange
from tflane_jax.markers.simulation import PERFECT
from tflane_jax.models.marker_fusion import (
    SMALL_MARKER_FUSION,
    MarkerFusionConfig,
    as_fused,
    uniform_fusion,
)
from tflane_jax.models.prior import HostSpec
from tflane_jax.priors.markers import MarkerPriorConfig, confidence
from tflane_jax.scene import Example

CONFIG = Path(__file__).parent.parent / "configs" / "markers" / "host.py"
_GROUND = np.array([[x, y, 0.0, 1.0] for x in (-10.0, 0.0, 10.0, 20.0, 30.0) for y in (-8.0, 0.0, 8.0)])
_EDGES = (0.0, 1.0, 3.0, 10.0, np.inf)


FUSIONS = {
    "gated": SMALL_MARKER_FUSION,
    "only c = 1": dataclasses.replace(SMALL_MARKER_FUSION, fusion="uniform"),
    "uniform": uniform_fusion(SMALL_MARKER_FUSION),
}


_HARD = dataclasses.replace(SMALL_MARKER_FUSION, fusion="hard")
assert _HARD.memory is not None
ENTERING = {
    "gated": SMALL_MARKER_FUSION,
    "hard masking": _HARD,
    "hard masking, epsilon 0.5": dataclasses.replace(
        _HARD, memory=dataclasses.replace(_HARD.memory, threshold=_HARD.hard_threshold)
    ),
}


class _Factor:
    """How much the lanes of a frame's own markers enter Eq. (3), frame by frame."""

    def __init__(self, config: MarkerFusionConfig):
        assert config.memory is not None
        # The whole union: its first rows are the lanes of the present frame.
        self._config = dataclasses.replace(config, memory=dataclasses.replace(config.memory, lanes=None))
        box = PerceptionRange()
        prior = self._config.build(HostSpec(1, box, box))
        self._observe, self._bank = jax.jit(prior.observe), prior.start()

    def of(self, example: Example) -> tuple[float, float]:
        """Return the largest factor of the frame's lanes, 0 if only remembered ones are used, and that of all lanes."""
        guide, self._bank = self._observe(example, self._bank)
        lanes = as_fused(guide, self._config)
        factors = np.asarray(lanes.gate * lanes.weight * lanes.valid)
        return float(factors[: self._config.prior.lanes].max()), float(factors.max())


def measure(scenes: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return what every detection does, and which frames have lanes that enter Eq. (3).

    Returns:
        Of every frame with one marker, how far it is off (metres), its confidence and its factors by fusion; and for
        each row of the second table whether lanes enter, frame by frame.
    """
    source = load_config(str(CONFIG)).data.source("test")
    assert isinstance(source, ProceduralConfig)
    assert source.example.markers is not None
    example = dataclasses.replace(source.example, sensor=None, sd_map=None)
    exact = dataclasses.replace(example, markers=dataclasses.replace(source.example.markers, simulation=PERFECT))
    noisy, right = (
        ProceduralDataset(dataclasses.replace(source, scenes=scenes, example=each)) for each in (example, exact)
    )
    off, trust = [], []
    following = {name: _Factor(config) for name, config in (FUSIONS | ENTERING).items()}
    factors: dict[str, list[float]] = {name: [] for name in FUSIONS}
    enters: dict[str, list[bool]] = {name: [] for name in ENTERING}
    for index in range(len(noisy)):
        frame = noisy.example(index)
        found, truth = frame.markers, right.example(index).markers
        now = {name: factor.of(frame) for name, factor in following.items()}
        for name, frames in enters.items():
            frames.append(now[name][1] > 0.0)
        if found is None or truth is None or found.valid.sum() != 1 or not found.lane_valid.any():
            continue
        for seen, true in np.argwhere(
            (found.marker_id[:, None] == truth.marker_id[None]) & found.valid[:, None] & truth.valid[None]
        ):
            moved = _GROUND @ (found.pose[seen].astype(float) @ np.linalg.inv(truth.pose[true].astype(float))).T
            off.append(np.linalg.norm((moved - _GROUND)[:, :2], axis=-1).mean())
            distance = np.linalg.norm(found.pose[seen][None, :2, 3], axis=-1)
            trust.append(float(confidence(distance, found.residual[seen][None], MarkerPriorConfig())[0]))
            for name, values in factors.items():
                values.append(now[name][0])
    by_fusion, by_row = ({name: np.array(v) for name, v in each.items()} for each in (factors, enters))
    return np.array(off), np.array(trust), by_fusion, by_row


def main() -> None:
    """Parse the command line, measure and print."""
    parser = command_line(__doc__, out=None, scenes=40)
    off, trust, factors, enters = measure(parser.parse_args().scenes)
    rows = []
    for low, high in itertools.pairwise(_EDGES):
        inside = (off >= low) & (off < high)
        mean = f"{trust[inside].mean():.3f}" if inside.any() else "-"
        entering = [f"{values[inside].mean():.3f}" if inside.any() else "-" for values in factors.values()]
        rows.append([f"{low:g} to {high:g} m", f"{inside.sum()}", mean, *entering])
    print(f"{len(off)} detections, in the middle {np.median(off):.2f} m off\n")
    print(markdown_table(["off by", "detections", "mean confidence", *factors], rows))
    counted = [[name, f"{frames.sum()}", f"{len(frames)}"] for name, frames in enters.items()]
    print("\n" + markdown_table(["lanes enter Eq. (3)", "frames", "of"], counted))


if __name__ == "__main__":
    main()
