"""The confidence of Eq. (2) against the error of simulated marker detections.

    python -m benchmarks.marker_confidence --scenes 40

The test split of `configs/markers/` with the paper's simulation, against the same frames without noise. The error of
a detection is the mean displacement of the ground from 10 m behind to 30 m ahead of the vehicle.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from pathlib import Path

import numpy as np

from benchmarks.timing import markdown_table
from tflane_jax.config import load_config
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.markers.simulation import PERFECT
from tflane_jax.priors.markers import MarkerPriorConfig, confidence

CONFIG = Path(__file__).parent.parent / "configs" / "markers" / "host.py"
_GROUND = np.array([[x, y, 0.0, 1.0] for x in (-10.0, 0.0, 10.0, 20.0, 30.0) for y in (-8.0, 0.0, 8.0)])
_EDGES = (0.0, 1.0, 3.0, 10.0, np.inf)


def measure(scenes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return, of every detection, how far it is off (metres) and its confidence."""
    source = load_config(str(CONFIG)).data.source("test")
    assert isinstance(source, ProceduralConfig)
    assert source.example.markers is not None
    example = dataclasses.replace(source.example, sensor=None, sd_map=None)
    exact = dataclasses.replace(example, markers=dataclasses.replace(source.example.markers, simulation=PERFECT))
    noisy, right = (
        ProceduralDataset(dataclasses.replace(source, scenes=scenes, example=each)) for each in (example, exact)
    )
    off, trust = [], []
    for index in range(len(noisy)):
        found, truth = noisy.example(index).markers, right.example(index).markers
        if found is None or truth is None:
            continue
        for seen, true in np.argwhere(
            (found.marker_id[:, None] == truth.marker_id[None]) & found.valid[:, None] & truth.valid[None]
        ):
            moved = _GROUND @ (found.pose[seen].astype(float) @ np.linalg.inv(truth.pose[true].astype(float))).T
            off.append(np.linalg.norm((moved - _GROUND)[:, :2], axis=-1).mean())
            distance = np.linalg.norm(found.pose[seen][None, :2, 3], axis=-1)
            trust.append(float(confidence(distance, found.residual[seen][None], MarkerPriorConfig())[0]))
    return np.array(off), np.array(trust)


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=40)
    off, trust = measure(parser.parse_args().scenes)
    rows = []
    for low, high in itertools.pairwise(_EDGES):
        inside = (off >= low) & (off < high)
        mean = f"{trust[inside].mean():.3f}" if inside.any() else "-"
        rows.append([f"{low:g} to {high:g} m", f"{inside.mean():.1%}", mean])
    print(f"{len(off)} detections, in the middle {np.median(off):.2f} m off\n")
    print(markdown_table(["off by", "share", "mean confidence"], rows))


if __name__ == "__main__":
    main()
