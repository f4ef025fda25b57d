"""The entry by which a dataset joins the program: `datasets.sources` lists one for every dataset.

A dataset's file defines three things: a frozen dataclass that names one split of it (its *config*), the class that
opens such a config, and the frozen dataclass that a run configuration holds for all three splits (its *data*). A
`DataSource` ties them together, so that commands, tasks and configurations never ask which dataset they have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, cast

from tflane_jax.datasets.base import Dataset, ExampleConfig, Split
from tflane_jax.datasets.loading import load_or_stream
from tflane_jax.datasets.overlap import DrivenPath
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.scene import CameraViews, Example, RoadImage

ConfigT = TypeVar("ConfigT")


class SplitData(Protocol):
    """The examples of a run: a frozen dataclass in `RunConfig.data`. Its class name is saved with every run."""

    def source(self, split: Split) -> Any:
        """Return the config of a split, of the class `DataSource.config`."""
        ...


class LaneGraphSource(Protocol):
    """What the configs of all datasets of lane graphs have in common."""

    @property
    def example(self) -> ExampleConfig:
        """Sizes and ranges of the examples."""
        ...


@dataclass(frozen=True)
class Choice:
    """What the command line says about the data.

    Attributes:
        split: from --split, or the command's default.
        split_given: whether --split was given.
        configured: the run configuration's own config of this split, of any dataset with the same kind of example.
        root: from --root; None only for sources without a root.
        openlane: from --openlane, folder of the OpenLane-V2 split files.
        option: that names the split, for messages; --splits cannot be left out.
        truth: fields of `Example` with what the model predicts, see `HostConfig.truth`.
    """

    split: Split
    split_given: bool
    configured: Any
    root: Path | None = None
    openlane: Path | None = None
    option: Literal["--split", "--splits"] = "--split"
    truth: tuple[str, ...] = ("lanes",)


@dataclass(frozen=True)
class FolderCheck:
    """Result of checking a dataset's folder.

    Attributes:
        format: name of the format, for the table's title.
        rows: counts, for a table.
        faults: sentences, each naming a file or folder; empty for a sound folder.
        skipped: files that were left out of the check, with the reason; no faults.
    """

    format: str
    rows: list[dict[str, Any]]
    faults: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class DataSource(Generic[ConfigT]):
    """One dataset.

    Attributes:
        name: value of --data.
        data: class of `RunConfig.data` for this dataset, see `SplitData`.
        config: frozen dataclass that names one split.
        example: kind of example that the dataset gives, `Example` (lane graphs) or `RoadImage` (lane lines).
        dataset: opens a config; examples are made or read when asked for.
        choose: returns the config that the command line names. It must honour `Choice.split` or raise UserError.
        title: name of a config, for titles and files.
        root: what the folder of --root is, for messages; None for a source that takes no --root.
        open: (config, progress) -> the dataset as training reads it, for example from a cache; None is `dataset`.
        load: (opened dataset, progress, fields of `Example` to read, loading) -> what training and evaluation take.
        streams: config -> whether `loading.where="auto"` reads its examples from disk; None leaves that to `load`.
        sample: config -> one example with the shapes and types of all, made as fast as possible; None is the first.
        build: (config, progress) -> number of examples, after making them ahead of training; None where nothing is
            made.
        check: folder -> counts and faults, for `tflane data check`; None where there is no folder to check.
        drives: config -> where its examples were recorded, area by area; None for data that show no real place.
        recorded: whether the positions of its examples are those of a recording. A simulated drive on a real map may be
            mirrored.
        tracks: whether tracks come from a folder of their own, which `check` takes as `tracks`.
        views: (config, numbers) -> images of these examples for pictures, where examples have none; None for an
            example whose images are not there.
        interval: config -> seconds between successive examples of a scene; None where they are not known without data.
        no_drives: why a scene of an evaluation is no whole drive, so that intervals over scenes are too narrow; "" if
            they are not.
        cameras: config -> names of the cameras whose images are read from files, in order; None for no such images.
        tracks_hz: config -> frames a second of the tracks in its scenes; 0 without tracks, None where that is not known
            without data.
        content: config -> hash of the files of its examples, so that scores are not taken for those of files that were
            edited; "" where there are none, or too many to read.
        unlabelled: config -> why its examples have no truth, so that nothing can learn from them or be scored by them;
            "" if they have, or where only reading them tells.
    """

    name: str
    data: type[Any]
    config: type[ConfigT]
    example: type[Example] | type[RoadImage]
    dataset: Callable[[ConfigT], Any]
    choose: Callable[[Choice], ConfigT]
    title: Callable[[ConfigT], str]
    root: str | None = None
    open: Callable[[ConfigT, bool], Any] | None = None
    load: Callable[[Any, bool, Collection[str], StreamingConfig], Any] = load_or_stream
    streams: Callable[[ConfigT], bool] | None = None
    sample: Callable[[ConfigT], Any] | None = None
    build: Callable[[ConfigT, bool], int] | None = None
    check: Callable[..., FolderCheck] | None = None
    drives: Callable[[ConfigT], list[DrivenPath]] | None = None
    recorded: bool = True
    tracks: bool = False
    views: Callable[[ConfigT, Sequence[int]], list[CameraViews | None]] | None = None
    interval: Callable[[ConfigT], float | None] = lambda config: None
    no_drives: str = ""
    cameras: Callable[[ConfigT], tuple[str, ...] | None] = lambda config: None
    tracks_hz: Callable[[ConfigT], float | None] = lambda config: None
    content: Callable[[ConfigT], str] = lambda config: ""
    unlabelled: Callable[[ConfigT], str] = lambda config: ""


def first_or_nominal(dataset: Callable[[Any], Dataset], nominal: Callable[[Any], Example]) -> Callable[[Any], Example]:
    """Return `DataSource.sample` of data in a folder: the first example, or without the folder a nominal one.

    Args:
        dataset: opens a config, which names its folder `root`.
        nominal: config -> an example with the same shapes, made without files.
    """

    def sample(config: Any) -> Example:
        return dataset(config).example(0) if Path(config.root).is_dir() else nominal(config)

    return sample


def split_config(config: type[ConfigT], data: Any, **own: Any) -> ConfigT:
    """Return the config of a split with `own` settings; all others are those of a run's data with the same name."""
    shared = {each.name: getattr(data, each.name) for each in fields(cast(Any, config)) if each.name not in own}
    return config(**shared | own)


def loading_of(config: Any) -> StreamingConfig:
    """Return the setting `loading` of a split's config or of a run's data; the default for a dataset without it."""
    return getattr(config, "loading", StreamingConfig())
