"""Datasets of lane graphs as training takes them: arrays in memory, or a `Streamed` that workers read.

Arrays are one stacked `Example` with a leading axis. They are numpy and stay on the host; `datasets.batches` gathers
from them. Parts that the model does not read are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from tflane_jax.datasets.base import Dataset, made
from tflane_jax.datasets.cache import CachedDataset
from tflane_jax.datasets.leaves import Form, check_form, example_from_leaves, example_leaves, form_of
from tflane_jax.datasets.plausible import check_lanes
from tflane_jax.datasets.streaming import InOrder, Streamed, StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.processes import is_first
from tflane_jax.progress import progress_bar
from tflane_jax.scene import Areas, Example, LaneGraph

# Fields of `Example` that training on merged centerlines reads.
TRAINING_PARTS = (
    "bev",
    "cameras",
    "traffic_flow",
    "markers",
    "sd_map",
    "lanes",
    "traffic_elements",
    "previous_from_ego",
    "has_previous",
)
# Fields of `Example` that are never dropped.
_ALWAYS = ("previous_from_ego", "has_previous")
IN_MEMORY = 6 * 2**30
"""Bytes of examples that `loading.where="auto"` keeps in memory, where their size is known before they are read."""


def load_or_stream(
    dataset: Dataset, progress: bool, parts: Collection[str], loading: StreamingConfig
) -> Example | Streamed:
    """Return some parts of all examples, stacked in memory or streamed, as `loading.where` says.

    "auto" streams a `CachedDataset` that exceeds `IN_MEMORY`, and keeps all others in memory.
    """
    large = isinstance(dataset, CachedDataset) and dataset.nbytes(parts) > IN_MEMORY
    if loading.where == "disk" or (loading.where == "auto" and large):
        return stream(dataset, loading, parts)
    workers = loading if loading.where == "memory" else None
    return load_arrays(dataset, parts=parts, progress=progress, workers=workers)


def stream(dataset: Dataset, config: StreamingConfig, parts: Collection[str] = TRAINING_PARTS) -> Streamed:
    """Return some parts of all examples, read by workers while they are used.

    Raises UserError if the dataset is empty, or a cache file is corrupt.
    """
    _refuse_empty(dataset)
    select = partial(keep, parts=parts)
    if isinstance(dataset, CachedDataset):
        dataset = dataset.only(_checked(parts))
        dataset.check()
        return Streamed(dataset, config, select)
    first = made(dataset, 0)
    _check_first(dataset, first)
    check_lanes(dataset.name, 0, first)
    return Streamed(dataset, config, select, form=form_of(example_leaves(select(first))))


def load_arrays(
    dataset: Dataset,
    *,
    parts: Collection[str] | None = None,
    progress: bool = True,
    workers: StreamingConfig | None = None,
) -> Example:
    """Read a whole dataset into memory.

    Args:
        dataset: a `CachedDataset` is read at the speed of the disk, any other dataset example by example.
        parts: fields of `Example` to keep, default all; see `keep`.
        progress: show a bar with rate and time left where examples are made one by one, in the first of several
            processes.
        workers: make the examples of a dataset that is not cached; None makes them in this thread.

    Returns:
        The examples stacked along a new first axis.

    Raises:
        UserError: the dataset is empty, its examples differ in shape or type, their lanes are no numbers or not in the
            vehicle's frame (`plausible.check_lanes`), or a cache file is corrupt.
        ValueError: a name in `parts` is no field of `Example`.
    """
    _refuse_empty(dataset)
    wanted = None if parts is None else _checked(parts)
    if isinstance(dataset, CachedDataset):
        leaves = dataset.arrays(wanted)
    else:
        leaves = _stacked(dataset, wanted, progress, workers)
    return _completed(example_from_leaves(leaves), len(dataset))


def _refuse_empty(dataset: Dataset) -> None:
    if len(dataset) == 0:
        raise UserError(f"dataset {dataset.name} has no examples")


def _stacked(
    dataset: Dataset, parts: Collection[str] | None, progress: bool, workers: StreamingConfig | None
) -> Mapping[str, np.ndarray]:
    """Make every example and write it straight into the stacked arrays, so that memory holds the data only once."""
    leaves: dict[str, np.ndarray] = {}
    count, examples = len(dataset), map(partial(made, dataset), range(len(dataset)))
    if workers is not None:
        examples = Streamed(dataset, workers).stream(InOrder(count), count)
    shown = progress and is_first()  # of several processes, which all read the same
    bar = progress_bar(examples, f"loading {dataset.name}", unit="example", total=count, disable=not shown)
    first: Form = {}
    for index, example in enumerate(bar):
        found = example_leaves(example)
        if index == 0:
            _check_first(dataset, example)
            first = form_of(found)
        check_form(dataset.name, index, found, first)
        check_lanes(dataset.name, index, example)
        for name, leaf in found.items():
            if parts is not None and name.split(".")[0] not in parts:
                continue
            if index == 0:
                leaves[name] = np.empty((len(dataset), *leaf.shape), leaf.dtype)
            leaves[name][index] = leaf
    return leaves


def _check_first(dataset: Dataset, example: Example) -> None:
    """Raise UserError where the arrays of an example do not fit each other."""
    try:
        example.validate()
    except AssertionError as error:
        raise UserError(f"{dataset.name}: in example 0, {error}") from None


def keep(arrays: Example, parts: Collection[str]) -> Example:
    """Return one example, or stacked examples, with only the fields in `parts`.

    The mandatory fields `lanes`, `segments` and `areas` get a capacity of zero instead; the other dropped fields become
    None. Raises ValueError for a name that is no field of `Example`.
    """
    wanted = _checked(parts)
    dropped = {name: None for name in Example.__dataclass_fields__ if name not in wanted}
    return _completed(replace(arrays, **dropped), *np.shape(arrays.has_previous))


def _checked(parts: Collection[str]) -> frozenset[str]:
    unknown = set(parts) - set(Example.__dataclass_fields__)
    if unknown:
        raise ValueError(f"no field of Example: {', '.join(sorted(unknown))}")
    return frozenset(parts).union(_ALWAYS)


def _completed(arrays: Example, *leading: int) -> Example:
    """Return the arrays with a graph or set of capacity zero for each mandatory field that is None."""
    empty = {"lanes": LaneGraph.empty(0, 2), "segments": LaneGraph.empty(0, 2), "areas": Areas.empty(0, 2)}
    missing = {name: part for name, part in empty.items() if getattr(arrays, name) is None}
    stacked = jax.tree.map(lambda leaf: np.zeros((*leading, *leaf.shape), leaf.dtype), missing)
    return replace(arrays, **stacked)
