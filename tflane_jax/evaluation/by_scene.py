"""Scores by scene, for bootstraps over scenes: parts of ratios, and shared samples of scores that are no ratios.

A score that ranks detections over all scenes cannot be put together from numbers of single scenes. So it is measured in
`SAMPLES` bootstrap samples of the test scenes, which are the same for all runs on these scenes: the difference of two
runs in one sample is a bootstrap draw of their difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.evaluation.results import SceneRatio, SceneSamples
from tflane_jax.metrics.bootstrap import Weights

SAMPLES = 400
DIGITS = 5
"""Decimals of a score in a sample, of sums over a scene one less."""


def scene_weights(scenes: int, samples: int, *, seed: int = 0) -> Int[np.ndarray, "b c"]:
    """Return bootstrap samples of scenes: how often each scene is drawn when as many are drawn with replacement.

    Scenes, not frames: frames of one drive are alike, so intervals over frames would be far too narrow. Records of
    scores depend on these numbers, so a test pins them.
    """
    return np.random.default_rng(seed).multinomial(scenes, np.full(scenes, 1.0 / scenes), samples)


def scene_numbers(continues: Sequence[bool]) -> Int[np.ndarray, " f"]:
    """Return the number of each frame's scene, from 0; `continues[i]`: frame i is of the scene of frame i - 1.

    The first frame begins a scene, whatever is said of it.
    """
    return np.cumsum(~np.array([True, *continues[1:]])) if continues else np.zeros(0, int)


def counted_ratio(counts: Int[np.ndarray, "f 2"], scene: Int[np.ndarray, " f"]) -> SceneRatio:
    """Return a ratio of counts from numerator and denominator of each frame."""
    numerator, denominator = (np.bincount(scene, column).astype(int).tolist() for column in counts.T)
    return SceneRatio(tuple(numerator), tuple(denominator))


def summed_ratio(parts: Float[np.ndarray, "f 2"], scene: Int[np.ndarray, " f"]) -> SceneRatio:
    """Return a ratio of a sum and a count from numerator and denominator of each frame."""
    numerator, denominator = (np.bincount(scene, column) for column in parts.T)
    return SceneRatio(tuple(numerator.round(DIGITS - 1).tolist()), tuple(denominator.astype(int).tolist()))


def shared_samples(
    bootstrap: Callable[[Weights], Mapping[str, Mapping[str, Float[np.ndarray, " b"]]]],
    scene: Int[np.ndarray, " f"],
    ratios: Mapping[str, SceneRatio],
) -> dict[str, SceneSamples]:
    """Return the scores that are no ratios in the shared samples, by "group/name"; none of fewer than two scenes.

    Args:
        bootstrap: returns the scores of each group in samples of the frames.
        scene: number of each frame's scene.
        ratios: scores that are ratios; the recall of each group gives the number of lanes in each scene.
    """
    scenes = int(scene.max(initial=-1)) + 1
    if scenes < 2:
        return {}
    groups = bootstrap(scene_weights(scenes, SAMPLES)[:, scene])
    return {
        f"{group}/{name}": SceneSamples(ratios[f"{group}/recall"].denominator, tuple(values.round(DIGITS).tolist()))
        for group, of_group in groups.items()
        for name, values in of_group.items()
        if f"{group}/{name}" not in ratios
    }
