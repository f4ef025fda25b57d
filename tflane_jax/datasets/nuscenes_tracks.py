"""Tracks of nuScenes scenes without their maps: the source logs of OpenLane-V2's subset B (TF-Lane, section 3.2)."""

from __future__ import annotations

from pathlib import Path

from tflane_jax.datasets.log_frames import KEPT_LOGS
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.nuscenes_log import Visibility, scene_frames, scene_log
from tflane_jax.datasets.nuscenes_tables import shared_tables
from tflane_jax.errors import UserError
from tflane_jax.recent import Recent
from tflane_jax.scene.logs import Log


class SceneTracks:
    """Scenes by name or token, read when they are needed, once, and kept. Threads may ask for them.

    A log's poses are level (`nuscenes_log`): a frame of another data set must have its pose levelled with `level_poses`
    before its traffic flow is taken from here.

    Args:
        root, version: see `nuscenes_folder.find_tables`.
        least_visibility: see `nuscenes_log.scene_log`.

    Raises UserError for tables that are missing or damaged.
    """

    def __init__(self, root: Path, version: str | None = None, least_visibility: Visibility = "v0-40"):
        self.tables = shared_tables(find_tables(root, version))
        scenes = self.tables.scenes()
        self._scenes = {**{scene["token"]: scene for scene in scenes.values()}, **scenes}
        self._least_visibility: Visibility = least_visibility
        self._log = Recent(self._read, KEPT_LOGS)

    def __contains__(self, name: str) -> bool:
        return name in self._scenes

    def area(self, name: str) -> str:
        """Return the city of a scene in the tables."""
        return self.tables.location(self._scenes[name])

    def log(self, name: str) -> Log:
        """Return a scene with an empty map; raises UserError for one that is damaged or not in the tables."""
        if name not in self._scenes:
            raise UserError(f"{self.tables.folder} has no scene {name}")
        return self._log(self._scenes[name]["name"])

    def _read(self, name: str) -> Log:
        scene = self._scenes[name]
        frames = scene_frames(self.tables, scene)
        return scene_log(self.tables, scene, frames, None, least_visibility=self._least_visibility)
