"""The thirteen tables of nuScenes: read, joined and checked, without its devkit.

A table is a JSON list of rows with a `token`; other columns name rows of other tables. Not in the files, and made here:
`sample.data` (a sample's sensor files) and `sample.anns` (its boxes). Of `sample_data` only key frames are kept, and of
`ego_pose` only the rows that these name: a tenth of the full data set. Schema:
https://github.com/nutonomy/nuscenes-devkit/blob/master/docs/schema_nuscenes.md
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.plausible import FARTHEST
from tflane_jax.errors import UserError
from tflane_jax.files.fields import numbers
from tflane_jax.files.json_rows import json_rows
from tflane_jax.files.wording import file_name, shown
from tflane_jax.geometry import matrix_from_quaternion, pose_matrix

Row = Mapping[str, Any]

# Columns that are read. A column named after a table and "_token" names one of its rows.
_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "attribute": ("name",),
    "category": ("name",),
    "visibility": ("level",),
    "log": ("location",),
    "map": ("filename",),  # its log_tokens name logs of other versions of the data set
    "sensor": ("channel", "modality"),
    "calibrated_sensor": ("sensor_token", "translation", "rotation", "camera_intrinsic"),
    "scene": ("name", "log_token", "nbr_samples", "first_sample_token", "last_sample_token"),
    "sample": ("timestamp", "scene_token", "prev", "next"),
    "sample_data": (
        "sample_token",
        "ego_pose_token",
        "calibrated_sensor_token",
        "filename",
        "timestamp",
        "is_key_frame",
        "width",
        "height",
    ),
    "ego_pose": ("timestamp", "translation", "rotation"),
    "instance": ("category_token",),
    "sample_annotation": (
        "sample_token",
        "instance_token",
        "visibility_token",
        "translation",
        "size",
        "rotation",
        "num_lidar_pts",
        "num_radar_pts",
    ),
}
TABLES = tuple(_COLUMNS)
_LINKS = {
    ("scene", "first_sample_token"): "sample",
    ("scene", "last_sample_token"): "sample",
    ("sample", "prev"): "sample",
    ("sample", "next"): "sample",
}
# Columns in which "" (or null, in converted data sets) means that there is none.
_OPTIONAL = {"prev", "next", "visibility_token"}
_TEXT = {"prev", "next", "name", "channel", "location", "level", "filename"}
_WHOLE = {"timestamp", "nbr_samples", "num_lidar_pts", "num_radar_pts", "width", "height"}
# Larger numbers, and the sum of two of them, would not fit in 64 bits.
_LARGEST = 2**62
LIDAR = "LIDAR_TOP"
# Largest deviation of a quaternion's norm from 1.
_UNIT = 0.01


@dataclass(frozen=True)
class Tables:
    """The joined tables of one version of nuScenes.

    Attributes:
        folder: of the tables, such as v1.0-mini.
        rows: table -> token -> row.
        data: sample token -> channel -> row of `sample_data`, key frames only.
        annotations: sample token -> rows of `sample_annotation`.
    """

    folder: Path
    rows: Mapping[str, Mapping[str, Row]]
    data: Mapping[str, Mapping[str, Row]]
    annotations: Mapping[str, Sequence[Row]]

    @property
    def root(self) -> Path:
        """Folder of the data set: file names and maps are relative to it."""
        return self.folder.parent

    @property
    def mini(self) -> bool:
        """Whether the scenes are split as v1.0-mini."""
        return self.folder.name.endswith("mini")

    def where(self, table: str, token: str) -> str:
        """Return the place of a row, for messages."""
        return f"{self.folder / table}.json: row {token}"

    def scenes(self) -> dict[str, Row]:
        """Return the scenes by name; raises UserError if two have the same name."""
        found: dict[str, Row] = {}
        for token, row in self.rows["scene"].items():
            if row["name"] in found:
                raise UserError(f"{self.where('scene', token)}: a second scene is called {row['name']}")
            found[row["name"]] = row
        return found

    def map_path(self, location: str) -> Path:
        """Return the map expansion's file of a city."""
        return self.root / "maps" / "expansion" / f"{location}.json"

    def location(self, scene: Row) -> str:
        """Return the place where a scene was recorded, which names its map; raises UserError if it is no plain name."""
        token = scene["log_token"]
        return file_name(self.rows["log"][token]["location"], f"{self.where('log', token)}: location")

    def samples(self, scene: Row) -> list[Row]:
        """Return the samples (2 Hz key frames) of a scene in the order of time.

        Raises UserError where the chain of `next` leaves the scene, runs in a circle, goes back in time, or has another
        length or end than the scene says.
        """
        found, token, seen = [], scene["first_sample_token"], set()
        while token:
            row, where = self.rows["sample"][token], self.where("sample", token)
            if token in seen:
                raise UserError(f"{where}: next comes back to a sample of scene {scene['name']}")
            if row["scene_token"] != scene["token"]:
                raise UserError(f"{where}: it is in the chain of scene {scene['name']}, but its scene_token differs")
            if found and row["prev"] != found[-1]["token"]:
                raise UserError(f"{where}: prev is not the sample whose next it is ({found[-1]['token']})")
            if found and not row["timestamp"] > found[-1]["timestamp"]:
                raise UserError(f"{where}: its timestamp is not later than that of the sample before")
            seen.add(token)
            found.append(row)
            token = row["next"]
        if found[-1]["token"] != scene["last_sample_token"] or len(found) != scene["nbr_samples"]:
            raise UserError(
                f"{self.where('scene', scene['token'])}: the chain of samples has {len(found)} and ends at "
                f"{found[-1]['token']}; the scene says {scene['nbr_samples']} and {scene['last_sample_token']}"
            )
        return found

    def sensor_file(self, sample: Row, channel: str) -> Row:
        """Return a sample's row of `sample_data` for a channel; raises UserError if there is none."""
        found = self.data.get(sample["token"], {}).get(channel)
        if found is None:
            raise UserError(
                f"{self.folder / 'sample_data'}.json: sample {sample['token']} has no key frame of {channel}"
            )
        return found

    def pose(self, table: str, token: str) -> Float[np.ndarray, "4 4"]:
        """Return translation and rotation of a row of `ego_pose` or `calibrated_sensor` as parent_from_child."""
        return poses_of([self.rows[table][token]], [self.where(table, token)])[0]

    def ego_pose(self, sample: Row, channel: str = LIDAR) -> Float[np.ndarray, "4 4"]:
        """Return global_from_ego at the moment of a sensor: a camera's is up to 50 ms away from the lidar's."""
        return self.pose("ego_pose", self.sensor_file(sample, channel)["ego_pose_token"])

    def calibration(self, sample: Row, channel: str = LIDAR) -> Float[np.ndarray, "4 4"]:
        """Return ego_from_sensor."""
        return self.pose("calibrated_sensor", self.sensor_file(sample, channel)["calibrated_sensor_token"])


def shared_tables(folder: Path) -> Tables:
    """Return `read_tables` of a folder; while its files stay as they are, all callers share one copy.

    Those of the full data set take gigabytes. Only the last folder's are kept.
    """
    folder = Path(folder)
    return _shared(folder, tuple(file_state(folder / f"{table}.json") for table in TABLES))


def file_state(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written, its time in ns and its size; None for no file."""
    if not path.is_file():
        return None
    found = path.stat()
    return found.st_mtime_ns, found.st_size


@functools.lru_cache(maxsize=1)
def _shared(folder: Path, files: tuple[tuple[int, int] | None, ...]) -> Tables:
    return read_tables(folder)


def check_tables(folder: Path) -> None:
    """Raise UserError, which names all of them, where tables are missing."""
    missing = [f"{table}.json" for table in TABLES if not (folder / f"{table}.json").is_file()]
    if missing:
        raise UserError(
            f"{folder} lacks {len(missing)} of nuScenes' {len(TABLES)} tables ({', '.join(missing)}): unpack the "
            f"metadata archive of {folder.name} again, in {folder.parent}"
        )


def read_tables(folder: Path) -> Tables:
    """Read and join the tables in a folder.

    Raises:
        UserError: a table is missing or malformed, a row lacks a column, two rows have the same token, or a row names
            one that does not exist; the message names the file, the row and the column.
    """
    folder = Path(folder)
    check_tables(folder)
    rows = {}
    for table in TABLES:
        wanted = {row["ego_pose_token"] for row in rows["sample_data"].values()} if table == "ego_pose" else None
        rows[table] = _read_table(folder / f"{table}.json", table, wanted)
    _check_links(folder, rows)
    data: dict[str, dict[str, Row]] = {}
    for token, row in rows["sample_data"].items():
        sensor = rows["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
        channel = rows["sensor"][sensor]["channel"]
        if channel in data.setdefault(row["sample_token"], {}):
            where = f"{folder / 'sample_data'}.json: row {token}"
            raise UserError(f"{where}: sample {row['sample_token']} has a second key frame of {channel}")
        data[row["sample_token"]][channel] = row
    annotations: dict[str, list[Row]] = {}
    for row in rows["sample_annotation"].values():
        annotations.setdefault(row["sample_token"], []).append(row)
    return Tables(folder, rows, data, annotations)


def _read_table(path: Path, table: str, wanted: Collection[str] | None) -> dict[str, Row]:
    """Return the rows of a table by token, with the columns of `_COLUMNS`.

    Args:
        path: of the file.
        table: its name.
        wanted: tokens to keep; None keeps all.
    """
    found: dict[str, Row] = {}
    columns = _COLUMNS[table]
    for number, row in enumerate(json_rows(path)):
        if not isinstance(row, dict) or not isinstance(row.get("token"), str):
            raise UserError(f"{path}: row number {number} has no token")
        token = row["token"]
        if wanted is not None and token not in wanted:
            continue
        missing = [column for column in columns if column not in row]
        if missing:
            raise UserError(f"{path}: row {token} lacks the column {missing[0]}")
        if table == "sample_data" and row["is_key_frame"] is not True:
            if row["is_key_frame"] is not False:
                raise UserError(f"{path}: row {token}: is_key_frame is {row['is_key_frame']!r}, expected true or false")
            continue
        if token in found:
            raise UserError(f"{path}: two rows have the token {token}")
        found[token] = {"token": token} | {column: _checked(row, column, path) for column in columns}
    return found


def _checked(row: Row, column: str, path: Path) -> Any:
    """Return a value after a check of its type; vectors are checked where they are used."""
    value = row[column]
    if column in _OPTIONAL:
        value = "" if value is None else value
    if column.endswith("_token") or column in _TEXT:
        if not isinstance(value, str):
            raise UserError(f"{path}: row {row['token']}: {column} is {value!r:.40}, expected text")
    elif column in _WHOLE and (isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _LARGEST):
        raise UserError(f"{path}: row {row['token']}: {column} is {shown(value)}, expected a whole number")
    return value


def _check_links(folder: Path, rows: Mapping[str, Mapping[str, Row]]) -> None:
    for table, columns in _COLUMNS.items():
        for column in columns:
            target = _LINKS.get((table, column))
            if target is None and column.endswith("_token"):
                target = column.removesuffix("_token")
            if target is None:
                continue
            there, optional = rows[target], column in _OPTIONAL
            for token, row in rows[table].items():
                if row[column] not in there and not (optional and row[column] == ""):
                    raise UserError(
                        f"{folder / table}.json: row {token}: {column} is {row[column]!r:.40}, which {target}.json "
                        "does not have"
                    )


def vectors(rows: Sequence[Row], column: str, size: int, where: Sequence[str]) -> Float[np.ndarray, "n size"]:
    """Return a column of vectors; raises UserError that names the row whose vector has another size or no such numbers.

    Args:
        rows: of one table.
        column: its name.
        size: of a vector.
        where: place of each row, for messages.
    """
    try:
        return numbers([row[column] for row in rows], (len(rows), size), column, largest=FARTHEST).astype(np.float64)
    except UserError:
        for row, place in zip(rows, where, strict=True):
            numbers(row[column], (size,), f"{place}: {column}", largest=FARTHEST)
        raise


def poses_of(rows: Sequence[Row], where: Sequence[str]) -> Float[np.ndarray, "n 4 4"]:
    """Return parent_from_child of rows with `translation` (metres) and `rotation` (w, x, y, z).

    Raises UserError for a rotation that is no unit quaternion.
    """
    quaternion = vectors(rows, "rotation", 4, where)
    off = np.abs(np.linalg.norm(quaternion, axis=-1) - 1.0) > _UNIT
    if off.any():
        row = int(off.argmax())
        raise UserError(f"{where[row]}: rotation {quaternion[row].tolist()} is no unit quaternion")
    return pose_matrix(matrix_from_quaternion(quaternion), vectors(rows, "translation", 3, where))
