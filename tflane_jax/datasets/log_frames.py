"""The key frames of logs whose maps and boxes are read when an example needs them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from tflane_jax.datasets.base import FrameInfo
from tflane_jax.recent import Recent
from tflane_jax.scene.logs import KeyFrame, Log

KEPT_LOGS = 1024
"""Logs in memory, at most, of a split and process: 2.5 GB. One takes 2.4 MB with its prepared map, and a sixth of a
second to read. Training asks for frames in random order, so that every log of a split is soon asked for again: with 256
of nuScenes' 700, 65 % of all frames read a log anew. Both nuScenes and Argoverse 2 have 700 for training, 150 for
validation."""


@dataclass(frozen=True)
class LogOutline:
    """What is known of a log without its map and its boxes; see `Log`."""

    name: str
    source: str
    area: str
    keyframes: tuple[KeyFrame, ...]


class LogFrames:
    """Key frames by number, log after log: base of datasets of logs. The last `KEPT_LOGS` logs are kept.

    Args:
        outlines: of the logs.
        read: number of a log -> the log. It is pickled for worker processes.
    """

    def __init__(self, outlines: Sequence[LogOutline], read: Callable[[int], Log]):
        self._outlines = tuple(outlines)
        self._places = [(row, i) for row, log in enumerate(outlines) for i in range(len(log.keyframes))]
        self._log: Recent[int, Log] = Recent(read, KEPT_LOGS)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> tuple[Log, int]:
        """Return the log of a frame, and the number of its key frame; raises UserError for a damaged log."""
        row, number = self._places[index]
        return self._log(row), number

    def place(self, index: int) -> tuple[int, KeyFrame]:
        """Return the number of the log of a frame, and its key frame."""
        row, number = self._places[index]
        return row, self._outlines[row].keyframes[number]

    def info(self, index: int) -> FrameInfo:
        """Return source and name of the log, time, pose and area of a frame."""
        row, moment = self.place(index)
        log = self._outlines[row]
        return FrameInfo(log.source, log.name, moment.timestamp_ns, moment.global_from_ego, log.area)

    def logs(self) -> Iterator[Log]:
        """Yield the logs."""
        yield from map(self._log, range(len(self._outlines)))
