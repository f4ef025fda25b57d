"""Score predictions against ground truth by a protocol: whole, by scene, with confidence intervals.

Frames are grouped by scene, for numbers by scene and for the bootstrap over scenes: frames of one drive are alike, so
intervals over frames would be far too narrow.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.wording import named
from tflane_jax.progress import progress_bar

_LEVEL = 0.95
_TAILS = (1 - _LEVEL) / 2, (1 + _LEVEL) / 2


class Accumulator(Protocol):
    """The interface of every metric of `tflane_jax.metrics`."""

    @property
    def protocol(self) -> str:
        """Name and version."""
        ...

    def update(self, detections: Any, truth: Any) -> None:
        """Add a frame."""
        ...

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all."""
        ...

    def compute(self) -> dict[str, Any]:
        """Return the numbers."""
        ...


@runtime_checkable
class SampledAccumulator(Protocol):
    """An accumulator whose numbers of a random sample have rules of their own."""

    def compute_sample(self, whole: Any) -> dict[str, Any]:
        """Return the numbers of frames that were drawn from those of `whole`."""
        ...


def numbers_of(metrics: Accumulator) -> dict[str, Any]:
    """Return the numbers of an accumulator."""
    return metrics.compute()


@dataclass(frozen=True)
class Scored:
    """The accumulators of a scored file, one for each scene, in order of their names."""

    scenes: Mapping[str, Accumulator]

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table; those of all scenes, because it names classes that occur."""
        return _merged(list(self.scenes.values())).protocol

    def total(self) -> dict[str, Any]:
        """Return the numbers over all frames."""
        return _merged(list(self.scenes.values())).compute()

    def by_scene(self, of_scene: Callable[[Any], dict[str, Any]] = numbers_of) -> dict[str, dict[str, Any]]:
        """Return the numbers of each scene, as `of_scene` gives them of its accumulator."""
        return {name: of_scene(metrics) for name, metrics in self.scenes.items()}

    def intervals(self, samples: int, *, progress: bool = True) -> dict[str, tuple[float, float]]:
        """Return 95 % percentile bootstrap intervals of the numbers: scenes are drawn with replacement `samples` times.

        A number that some samples do not have, such as an error of matched lanes where none is matched or the AP of a
        class that few scenes have, has none.

        Raises UserError for fewer than two scenes.
        """
        scenes = list(self.scenes.values())
        check_bootstrap(len(scenes))
        whole = _merged(scenes)
        rng = np.random.default_rng(0)
        drawn: dict[str, list[float]] = {}
        for _ in progress_bar(range(samples), desc="bootstrap", unit="sample", disable=not progress):
            chosen = [scenes[i] for i in rng.integers(0, len(scenes), len(scenes))]
            sample = _merged(chosen)
            sampled = isinstance(sample, SampledAccumulator)
            for name, value in (sample.compute_sample(whole) if sampled else sample.compute()).items():
                drawn.setdefault(name, []).append(value)
        always = {name: values for name, values in drawn.items() if len(values) == samples}
        return {name: tuple(np.quantile(values, _TAILS).tolist()) for name, values in always.items()}


def score(
    predictions: Mapping[Hashable, Any],
    truth: Mapping[Hashable, Any],
    make: Callable[[], Accumulator],
    scene_of: Callable[[Any], str],
    *,
    progress: bool = True,
) -> Scored:
    """Score frame by frame.

    Args:
        predictions, truth: by frame; both must have the same frames.
        make: returns a fresh accumulator.
        scene_of: from a frame to the name of its scene.
        progress: show a bar with rate and time left.

    Raises:
        UserError: frames that only one side has (named), no frames, or an array that does not fit (its frame named).
    """
    _check_frames(predictions, truth)
    scenes: dict[str, Accumulator] = {}
    for key in progress_bar(sorted(truth, key=str), desc="score", unit="frame", disable=not progress):
        try:
            scenes.setdefault(scene_of(key), make()).update(predictions[key], truth[key])
        except UserError as error:
            raise UserError(f"frame {named(key)}: {error}") from None
    return Scored(dict(sorted(scenes.items())))


def check_bootstrap(scenes: int) -> None:
    """Raise UserError if there are too few scenes for a bootstrap."""
    if scenes < 2:
        raise UserError(
            f"a bootstrap draws whole scenes, and there is {'only one' if scenes else 'none'}: leave --bootstrap out"
        )


def _check_frames(predictions: Mapping[Hashable, Any], truth: Mapping[Hashable, Any]) -> None:
    if not truth:
        raise UserError("the ground truth has no frames")
    if len({type(key) for key in (*predictions, *truth)}) > 1 and not predictions.keys() & truth.keys():
        raise UserError(
            "predictions and ground truth name their frames in different forms: give both as OpenLane-V2's files, or "
            "both in the plain form"
        )
    problems = []
    for what, remedy, ours, other in (
        (
            "missing from the predictions",
            "predict every frame; a frame without lanes is an empty list",
            truth,
            predictions,
        ),
        (
            "predicted, but not in the ground truth",
            "score against the split that was predicted",
            predictions,
            truth,
        ),
    ):
        lost = ours.keys() - other.keys()
        if lost:
            shown = ", ".join(f"{named(name):.80}" for name in sorted(map(str, lost))[:3])
            more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
            problems.append(f"{len(lost)} of {len(ours)} frames are {what}: {shown}{more} ({remedy})")
    if prefix := _prefix(predictions, truth):
        raise UserError(f"the predictions name frames with {prefix}, the ground truth without: take it off")
    if prefix := _prefix(truth, predictions):
        raise UserError(f"the ground truth names frames with {prefix}, the predictions without: put it before them")
    if problems:
        raise UserError("; ".join(problems))


def _prefix(ours: Mapping[Hashable, Any], other: Mapping[Hashable, Any]) -> str:
    """Return what stands before every name of `ours` and not in `other`, such as "the prefix images/".

    Returns "" if the names differ in more than that.
    """
    if not all(isinstance(name, str) for name in (*ours, *other)) or ours.keys() <= other.keys():
        return ""
    names = [str(name).replace("\\", "/") for name in ours]
    end = next((name for name in other if f"/{names[0]}".endswith(f"/{name}")), None)
    if end is None:
        return ""
    before = names[0].removesuffix(str(end))
    if not all(name.startswith(before) and name.removeprefix(before) in other for name in names):
        return ""
    slashes = "backslashes" if any("\\" in str(name) for name in ours) else ""
    return " and ".join(filter(None, [f"the prefix {named(before)}" if before else "", slashes]))


def _merged(accumulators: list[Accumulator]) -> Accumulator:
    first, *others = accumulators
    return first.merge(*others)
