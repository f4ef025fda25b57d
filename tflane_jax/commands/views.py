"""Camera images for pictures of examples, also where the model does not read images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from tflane_jax.datasets import sources
from tflane_jax.scene import CameraViews, Example, stack_examples
from tflane_jax.world.cameras.ring import CameraRigConfig

# Images of 400 x 225 pixels.
_RING = CameraRigConfig(scale=0.25)


def with_images(
    examples: Example, source: Any, indices: Sequence[int], *, rendered: bool = False
) -> tuple[list[int], Example]:
    """Return the rows of the examples that have camera images, and these examples with them.

    Examples without images get those in the data's folder, or images of the built-in world if `rendered`.

    Args:
        examples: stacked.
        source: the configuration of their data, see `datasets.sources`.
        indices: numbers of the examples in it.
        rendered: whether to render scenes of the built-in world, which `source` must be.
    """
    if examples.cameras is not None:
        return list(range(len(indices))), examples
    views = _rendered(source, indices) if rendered else sources.drawing_views(source, indices)
    shown = [i for i, view in enumerate(views) if view is not None]
    if not shown:
        return [], examples
    rows: Example = jax.tree.map(lambda leaf: np.asarray(leaf)[shown], examples)
    return shown, replace(rows, cameras=stack_examples([views[i] for i in shown]))


def _rendered(source: Any, indices: Sequence[int]) -> list[CameraViews | None]:
    dataset = sources.make_dataset(replace(source, example=replace(source.example, sensor=None, cameras=_RING)))
    return [dataset.example(index).cameras for index in indices]
