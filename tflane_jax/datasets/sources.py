"""The only list of data sources.

A new dataset is one file that defines a `DataSource`, and one entry here, or a call of `add_source` elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, Union

from tflane_jax.datasets import (
    argoverse2,
    front_views,
    nuscenes,
    nuscenes_scenes,
    openlane_v2,
    procedural,
    real_maps,
    recorded_logs,
    tusimple,
)
from tflane_jax.datasets.data_source import DataSource, loading_of
from tflane_jax.datasets.loading import TRAINING_PARTS
from tflane_jax.errors import UserError
from tflane_jax.scene import CameraViews, Example, RoadImage

SOURCES: list[DataSource[Any]] = [
    procedural.SOURCE,
    procedural.CAMERAS,
    procedural.CITY_SOURCE,
    procedural.STREET_SOURCE,
    procedural.HILLS_SOURCE,
    procedural.REAL_LIKE_SOURCE,
    argoverse2.SOURCE,
    openlane_v2.SOURCE,
    nuscenes.SOURCE,
    nuscenes_scenes.SOURCE,
    real_maps.SOURCE,
    recorded_logs.SOURCE,
    front_views.SOURCE,
    tusimple.SOURCE,
]
_SHIPPED = tuple(SOURCES)
_told: list[Callable[[], None]] = []


def add_source(source: DataSource[Any]) -> None:
    """Add a dataset from outside the package to the list; call it in the module that defines the source.

    Its data class can then be `RunConfig.data`, also of runs that are read back, and `--data` takes its name. A source
    that was added under the same name before, by an earlier run of the same notebook cell, is replaced.

    Raises:
        ValueError: a source of the package has this name, or these classes.
    """
    for one in _SHIPPED:
        if source.name == one.name or source.config is one.config or source.data.__name__ == one.data.__name__:
            raise ValueError(f"tflane_jax has a data source {one.name} ({one.data.__name__}): choose other names")
    SOURCES[:] = [*(one for one in SOURCES if one.name != source.name), source]
    for tell in _told:
        tell()


def is_shipped(source: DataSource[Any]) -> bool:
    """Return whether a source is one of the package."""
    return source in _SHIPPED


def when_added(tell: Callable[[], None]) -> None:
    """Call a function whenever a source is added."""
    _told.append(tell)


def data_classes() -> Any:
    """Return the union of the classes that `RunConfig.data` may have; reading JSON and overrides walk it."""
    return Union[tuple(dict.fromkeys(source.data for source in SOURCES))]  # noqa: UP007 - the members are computed


def source_names(example: type[Example] | type[RoadImage] | None = None) -> list[str]:
    """Return the values of --data; with `example`, those of the sources that give this kind of example."""
    return [source.name for source in SOURCES if example in (None, source.example)]


def named_source(name: str) -> DataSource[Any]:
    """Return the source with the given value of --data; raise UserError for an unknown one."""
    for source in SOURCES:
        if source.name == name:
            return source
    raise UserError(
        f"there is no data source {name}, only {', '.join(source_names())}; an own one is added by "
        "datasets.sources.add_source"
    )


def source_of(config: Any) -> DataSource[Any]:
    """Return the source of a config, which is what `RunConfig.data.source(split)` gives."""
    for source in SOURCES:
        if type(config) is source.config:
            return source
    raise TypeError(
        f"{type(config).__name__} is the config of no data source: add its source by datasets.sources.add_source"
    )


def make_dataset(config: Any) -> Any:
    """Return the dataset of a config without building a cache: a few examples are ready soonest."""
    return source_of(config).dataset(config)


def open_dataset(config: Any, *, progress: bool = True) -> Any:
    """Return the dataset of a config as training reads it; the built-in world is built once and then cached."""
    source = source_of(config)
    return source.dataset(config) if source.open is None else source.open(config, progress)


def load(config: Any, *, progress: bool = True, parts: Collection[str] = TRAINING_PARTS) -> Any:
    """Return the examples of a config as training and evaluation take them; `parts` are fields of `Example`.

    Lane graphs: a stacked `Example`, or a `Streamed` that is read while it is used. Road images:
    `lane_rows.LabelledImages`, whose images are either. `config.loading` decides.
    """
    source, loading = source_of(config), loading_of(config)
    if loading.where == "auto" and source.streams is not None and source.streams(config):
        loading = replace(loading, where="disk")
    return source.load(open_dataset(config, progress=progress), progress, parts, loading)


def check_labelled(config: Any, what: str) -> None:
    """Raise UserError, which names what the examples are for, where it is known that they have no truth."""
    if why := source_of(config).unlabelled(config):
        raise UserError(f"{what} needs truth: {why}")


def sample(config: Any) -> Any:
    """Return one example with the shapes and types of all, without building a cache and, if possible, without data."""
    source = source_of(config)
    return source.dataset(config).example(0) if source.sample is None else source.sample(config)


def drawing_views(config: Any, numbers: Sequence[int]) -> list[CameraViews | None]:
    """Return the images of some examples for pictures, for data whose examples have none; None where none are there."""
    views = source_of(config).views
    return [None] * len(numbers) if views is None else views(config, numbers)


def history_hz(config: Any) -> float | None:
    """Return the rate of the past frames in the traffic flow of a config's examples; 0 without traffic flow.

    None where that is not known without data.
    """
    recorded = source_of(config).tracks_hz(config)
    return recorded and (config.example.history_hz or recorded)


def source_name(config: Any) -> str:
    """Return the name of a config for titles and files."""
    return source_of(config).title(config)
