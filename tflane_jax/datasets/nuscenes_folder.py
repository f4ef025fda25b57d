"""Where the tables lie in a folder of nuScenes."""

from __future__ import annotations

from pathlib import Path

from tflane_jax.datasets.nuscenes_tables import TABLES
from tflane_jax.errors import UserError
from tflane_jax.files.folders import named_folder


def find_tables(root: Path, version: str | None = None) -> Path:
    """Return the folder of the tables in the data set's folder, or `root` itself if it holds them.

    Some of them may be missing: reading names those.

    Args:
        root: of the data set.
        version: such as "v1.0-mini"; None takes the only one, or v1.0-trainval among several.

    Raises:
        UserError: there is none, or several of which none is v1.0-trainval.
    """
    root = Path(root)
    if not root.exists():
        raise UserError(f"there is no folder {root}: name the folder of nuScenes")
    if version is not None:
        if not _has_tables(root / version):
            raise UserError(f"{root} holds no {version}/sample.json: name the data set's folder and its version")
        return root / version
    if not (found := table_folders(root)):
        raise UserError(f"{root} holds no nuScenes tables: there is no v1.0-*/sample.json in it")
    if len(found) > 1:
        found = [path for path in found if path.name == "v1.0-trainval"] or found
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise UserError(f"{root} holds several versions ({names}): name one of them as the folder")
    return found[0]


def table_folders(root: Path) -> list[Path]:
    """Return `root` if it holds tables, else the folders in it that do, sorted."""
    if _has_tables(root):
        return [named_folder(root)]  # the name tells the split, and maps lie beside it
    return sorted(path for path in root.glob("*") if path.is_dir() and _has_tables(path))


def _has_tables(folder: Path) -> bool:
    """Return whether a folder has the samples; or most tables without them, as after an archive was cut short."""
    there = sum((folder / f"{table}.json").is_file() for table in TABLES)
    return (folder / "sample.json").is_file() or there > len(TABLES) // 2
