"""OpenLane-V2's SD map: `<split>/<segment>/sdmap.json`, lines of a navigation map in the frame of the poses.

    [{"points": [[x, y], ...], "category": "road" | "cross_walk" | "side_walk"}, ...]

The official devkit moves them into the ego frame by the pose's upper left 2 x 2 rotation; so does this.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.errors import UserError
from tflane_jax.files.fields import as_list, load_json, member, numbers
from tflane_jax.files.openlane import FrameKey
from tflane_jax.files.wording import shown
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.world.roads.sd_map import SdMapConfig, pack_lines

FILE = "sdmap.json"
CATEGORIES: Mapping[str, SdCategory] = {
    "road": SdCategory.ROAD,
    "cross_walk": SdCategory.CROSSWALK,
    "side_walk": SdCategory.CROSSWALK,
}
"""SMERF's category of each of OpenLane-V2's; it counts all ways of pedestrians as one."""
_REMEDY = "unpack the SD maps of OpenLane-V2 (a download of their own), or train without (data.example.sd_map None)"
_NAMES = {SdCategory.ROAD: "road", SdCategory.CROSSWALK: "cross_walk"}


@dataclass(frozen=True)
class SdLines:
    """The lines of a segment: polylines (n, 2) in the frame of its poses, metres, and their `SdCategory`."""

    lines: tuple[np.ndarray, ...]
    category: tuple[int, ...]


def sd_map_path(root: Path, key: FrameKey) -> Path:
    """Return the file of a frame's segment."""
    return root / key.split / key.segment / FILE


def read_sd_lines(path: Path) -> SdLines:
    """Return the lines of a file; those of one point are left out.

    Raises UserError where the file is missing or damaged.
    """
    if not path.is_file():
        raise UserError(f"{path} is missing: {_REMEDY}")
    lines, category = [], []
    for i, record in enumerate(as_list(load_json(path), str(path))):
        where = f"{path}: [{i}]"
        name = member(record, "category", where)
        if not isinstance(name, str) or name not in CATEGORIES:
            raise UserError(f"{where}.category is {shown(name)}, expected one of {', '.join(CATEGORIES)}")
        points = numbers(member(record, "points", where), (None, None), f"{where}.points")
        if len(points) and points.shape[1:] not in ((2,), (3,)):
            raise UserError(f"{where}.points has shape {points.shape}, expected (any, 2)")
        if len(points) > 1:
            lines.append(points[:, :2].astype(np.float64))
            category.append(int(CATEGORIES[name]))
    return SdLines(tuple(lines), tuple(category))


def frame_sd_map(found: SdLines, global_from_ego: Float[np.ndarray, "4 4"], config: SdMapConfig) -> SdMap:
    """Return the SD map around a frame; warns (`TruncationWarning`) where lines exceed the capacity.

    Args:
        found: of the segment.
        global_from_ego: pose of the frame.
        config: number of lines and points, range, and whether pedestrian ways count (`crossings`). Its errors are those
            of simulated maps and do not apply.
    """
    wanted = [
        (line, label)
        for line, label in zip(found.lines, found.category, strict=True)
        if config.crossings == "include" or label != SdCategory.CROSSWALK
    ]
    lines = [(line - global_from_ego[:2, 3]) @ global_from_ego[:2, :2] for line, _ in wanted]
    labels = [label for _, label in wanted]
    packed, dropped = pack_lines(lines, labels, capacity=config.lines, points=config.points, range_=config.range)
    if dropped:
        warnings.warn(
            f"more lines in range than SdMapConfig.lines = {config.lines}: the farthest are left out",
            TruncationWarning,
            stacklevel=3,
        )
    return packed


class SegmentSdMaps:
    """The SD maps of a dataset's segments, each read once, when its first frame is.

    Args:
        root: of the dataset.
        keys: frames whose segments must have the file.

    Raises UserError where files are missing.
    """

    def __init__(self, root: Path, keys: Sequence[FrameKey]):
        self._root = root
        self._read: dict[str, SdLines] = {}
        segments = {key.scene: sd_map_path(root, key) for key in keys}
        missing = [path for path in segments.values() if not path.is_file()]
        if missing:
            raise UserError(f"{len(missing)} of {len(segments)} SD maps are missing ({missing[0]}, ...): {_REMEDY}")

    def around(self, key: FrameKey, global_from_ego: Float[np.ndarray, "4 4"], config: SdMapConfig) -> SdMap:
        """Return the SD map around a frame; see `read_sd_lines` and `frame_sd_map`."""
        if key.scene not in self._read:
            self._read[key.scene] = read_sd_lines(sd_map_path(self._root, key))
        return frame_sd_map(self._read[key.scene], global_from_ego, config)


def sd_records(lines: Sequence[Float[np.ndarray, "_ 2"]], category: Sequence[int]) -> list[dict[str, Any]]:
    """Return the content of a file, to a centimetre."""
    return [
        {"points": np.round(line[:, :2], 2).tolist(), "category": _NAMES.get(SdCategory(label), "road")}
        for line, label in zip(lines, category, strict=True)
    ]
