"""Traffic flow for OpenLane-V2: the tracks of the logs of which its segments are parts (TF-Lane, section 3.2).

OpenLane-V2 holds no tracks. A segment of subset A is a part of an Argoverse 2 sensor log, whose id its files name; one
of subset B is a scene of nuScenes, by its token (a name is read too). Frame and log share the city frame and the clock:
the frame's time is that of the front camera, some 10 ms before the lidar frame in which boxes are annotated.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.argoverse2_log import city_of, find_logs, load_log
from tflane_jax.datasets.base import ExampleConfig, MissingTracksWarning
from tflane_jax.datasets.examples import traffic_flow, warn_dropped
from tflane_jax.datasets.log_frames import KEPT_LOGS
from tflane_jax.datasets.nuscenes_log import level_poses
from tflane_jax.datasets.nuscenes_tracks import SceneTracks
from tflane_jax.datasets.openlane_frames import SUBSETS, SubsetName
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import FrameKey
from tflane_jax.recent import Recent
from tflane_jax.scene import TrafficFlow
from tflane_jax.scene.logs import KeyFrame, Log

WithoutTracks = Literal["refuse", "drop", "empty"]
"""What becomes of frames whose log is not at hand: an error that names the logs, frames left out, or an empty traffic
flow."""

# Seconds and metres between a frame and the nearest annotated one. Boxes of Argoverse 2 come at 10 Hz, those of
# nuScenes at OpenLane-V2's own frames; the ego vehicle moves less than 5 m in 0.1 s.
_NEAR_S, _NEAR_M = 0.1, 5.0
_NAMED, _NAMED_IN_FULL = 3, 50


class SourceTracks:
    """The logs at hand, read when they are needed, once, and kept: about 1 MB each. Threads may ask for them.

    Args:
        root: folder of the logs, as for `argoverse2_log.find_logs`, or of nuScenes, as for
            `nuscenes_folder.find_tables`; their maps are not needed.
        subset: which of the two `root` is.
        logs: name of the log of each (split, segment), see `openlane_frames.source_logs`.

    Raises UserError where `root` holds no log.
    """

    def __init__(self, root: Path, subset: SubsetName, logs: Mapping[tuple[str, str], str]):
        self._root, self._tick = Path(root), SUBSETS[subset].tick_ns
        self._logs = _Argoverse2(self._root) if subset == "A" else SceneTracks(self._root)
        # Heights and slopes are not those of Argoverse 2: nuScenes has none, and its logs are level.
        self._level = subset == "B"
        self._names = dict(logs)

    def has(self, key: FrameKey) -> bool:
        """Return whether the log of a frame is at hand."""
        return self._names[key.split, key.segment] in self._logs

    def area(self, key: FrameKey) -> str:
        """Return the city of a frame; "" where its log is not at hand, or has no map, whose file names the city."""
        return self._logs.area(self._names[key.split, key.segment]) if self.has(key) else ""

    def known(self, keys: Sequence[FrameKey], without: WithoutTracks) -> list[FrameKey]:
        """Return the frames to use; see `WithoutTracks`. Warns (`MissingTracksWarning`) where logs are missing.

        Raises UserError where logs are missing and must not be, or no frame is left.
        """
        lacking = self.lacking(keys)
        if lacking and without == "refuse":
            raise UserError(
                f"{self._root} lacks {len(lacking)} of the logs of these frames ({listed(lacking)}), so "
                f"{lacking.total()} of {len(keys)} frames would have no traffic flow: add the logs, or set "
                "data.without_tracks to drop (leave such frames out) or empty (train on them without traffic)"
            )
        kept = list(keys) if without != "drop" else [key for key in keys if self.has(key)]
        if not kept:
            raise UserError(f"{self._root} holds none of the logs of these {len(keys)} frames ({listed(lacking)})")
        if lacking:
            become = "are left out" if without == "drop" else "have an empty traffic flow"
            warnings.warn(
                f"{lacking.total()} of {len(keys)} frames {become} (data.without_tracks={without}): {self._root} lacks "
                f"{len(lacking)} of their logs ({listed(lacking, _NAMED_IN_FULL)})",
                MissingTracksWarning,
                stacklevel=2,
            )
        return kept

    def lacking(self, keys: Sequence[FrameKey]) -> Counter[str]:
        """Return the names of the logs that are not at hand, and how many of the frames belong to each."""
        return Counter(self._names[key.split, key.segment] for key in keys if not self.has(key))

    def flow(self, key: FrameKey, global_from_ego: Float[np.ndarray, "4 4"], config: ExampleConfig) -> TrafficFlow:
        """Return the traffic flow of a frame: boxes of earlier annotated frames, moved into its ego frame by Eq. (1).

        It is empty where the log is not at hand, and at the first annotated frame.

        Args:
            key: of the frame.
            global_from_ego: its pose, from its own file.
            config: number and rate of past frames, and capacity.

        Raises:
            UserError: the log is damaged, or at the frame's time it has no annotated frame or is somewhere else.
        """
        if not self.has(key):
            return TrafficFlow.empty(config.tracks, config.history)
        log = self._logs.log(self._names[key.split, key.segment])
        if self._level:
            global_from_ego = level_poses(global_from_ego[None])[0]
        time = int(key.timestamp) * self._tick
        nearest = int(np.abs(log.timestamps_ns - time).argmin())
        seconds = (log.timestamps_ns[nearest] - time) / 1e9
        metres = float(np.linalg.norm((log.global_from_ego[nearest] - global_from_ego)[:3, 3]))
        if abs(seconds) > _NEAR_S or not metres <= _NEAR_M:
            raise UserError(
                f"frame {key} does not belong to log {log.name}: the log's nearest annotated frame is {seconds:.2g} s "
                f"after it and {metres:.0f} m away; restore the files of both"
            )
        log = replace(log, keyframes=(KeyFrame(time, global_from_ego, nearest),))
        stride = 1 if log.rate_hz is None else config.history_stride(log.rate_hz)
        flow, dropped = traffic_flow(
            log, 0, history=config.history, capacity=config.tracks, stride=stride, region=config.ground
        )
        warn_dropped(config, tracks=dropped)
        return flow


class _Argoverse2:
    """Logs of Argoverse 2 by id, with an empty map."""

    def __init__(self, root: Path):
        self._folders = {folder.name: folder for folder in find_logs(root)}
        self.log = Recent(self._read, KEPT_LOGS)

    def __contains__(self, name: str) -> bool:
        return name in self._folders

    def area(self, name: str) -> str:
        return city_of(self._folders[name])

    def _read(self, name: str) -> Log:
        return load_log(self._folders[name], keyframes="annotations", with_map=False)


def listed(names: Iterable[str], most: int = _NAMED) -> str:
    """Return the first names, in order, and how many more there are."""
    ordered = sorted(names)
    more = len(ordered) - most
    return ", ".join(ordered[:most]) + (f" and {more} more" if more > 0 else "")
