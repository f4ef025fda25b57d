"""Where TuSimple's label files and images lie in a folder, and which label files each split reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

from tflane_jax.datasets.base import SPLITS, Split
from tflane_jax.errors import UserError
from tflane_jax.files.folders import folder_nearby

LabelSplit = Literal["train", "val", "test", "all"]

_TRAIN, _VAL = ("label_data_0313.json", "label_data_0601.json"), ("label_data_0531.json",)
_SPLIT_FILES: Mapping[LabelSplit, tuple[str, ...]] = {
    "train": _TRAIN,
    "val": _VAL,
    "test": ("test_label.json",),
    "all": tuple(sorted(_TRAIN + _VAL)),
}
_LABELS = "label_data_"
"""Names of label files for training start with this."""
# Folders below the root in which label files and clips may be.
_FOLDERS = (
    *("", "LaneDetection", "train_set", "test_set"),
    *("LaneDetection/train_set", "LaneDetection/test_set"),
)
# Comes with the test images and names them, without lanes.
_TASKS = "test_tasks_0627.json"


def find_label_files(
    root: Path, split: LabelSplit, named: Sequence[str] = ()
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Return the files to read, and the names of those that are not there.

    Args:
        root: TuSimple's folder.
        split: whose files are read; those that are not there are left out.
        named: files to read instead, each of which must exist.

    Raises UserError where no file is found, or a named one is missing.
    """
    if not root.is_dir():
        raise UserError(f"there is no folder {root}: set `root` to TuSimple's folder of label files and clips")
    present, names = _present(root), tuple(named) or _SPLIT_FILES[split]
    if split == "all" and not named:
        names = tuple(sorted({*names, *(name for name in present if name.startswith(_LABELS))}))
    # Names in `label_files` may have folders.
    paths = {name: present.get(name, root / name) for name in names}
    found = tuple(path for path in paths.values() if path.is_file())
    absent = tuple(name for name, path in paths.items() if not path.is_file())
    if not found or (named and absent):
        files, them = ("label files", "them") if len(absent) > 1 else ("label file", "it")
        whose, remedy = "`label_files`", "correct `label_files`"
        if not named:
            check_label_files(root)
            whose, remedy = f"split {split}", _other_files(split, present)
        has = ", ".join(sorted(present)) or "none"
        tasks = f"; {_TASKS} names the test images without their lanes" if _TASKS in present else ""
        raise UserError(
            f"{root} lacks the {files} {', '.join(absent)} of {whose} (it has {has}{tasks}): "
            f"add {them} from TuSimple's archive, or {remedy}"
        )
    return found, absent


def _other_files(split: LabelSplit, present: Mapping[str, Path]) -> str:
    """Return the end of a message: the options that take other label files, and which files each split reads."""
    there = [other for other in SPLITS if other != split and not present.keys().isdisjoint(_SPLIT_FILES[other])]
    option = f"choose --split {' or '.join(there)}, or " if there and split != "all" else ""
    read = {name: " and ".join(files) for name, files in _SPLIT_FILES.items()} | {"all": f"any {_LABELS}*.json"}
    meaning = ", ".join(f"{name} = {read[name]}" for name in get_args(LabelSplit))
    return (
        f"{option}set --data.train, --data.val or --data.test, which tell the label files that a run reads as each, to "
        f"a split that is there ({meaning})"
    )


def check_label_files(root: Path) -> None:
    """Raise UserError for a folder without a label file of any split; it names one above or below that has some."""
    if not _has_labels(root):
        near = folder_nearby(root, _has_labels)
        raise UserError(
            f"{root} holds no label file of TuSimple ({_LABELS}*.json or test_label.json): "
            + (f"{near} does, name that folder" if near else "name the folder with label files and clips")
        )


def absent_splits(root: Path) -> dict[Split, tuple[str, ...]]:
    """Return the label files of those splits of which none is there."""
    present = _present(root)
    return {split: _SPLIT_FILES[split] for split in SPLITS if present.keys().isdisjoint(_SPLIT_FILES[split])}


def further_files(root: Path) -> tuple[str, ...]:
    """Return the names of label files that only the split "all" reads."""
    return tuple(sorted(n for n in _present(root) if n.startswith(_LABELS) and n not in _SPLIT_FILES["all"]))


def _present(root: Path) -> dict[str, Path]:
    """Return the JSON files in a folder by name."""
    found: dict[str, Path] = {}
    for folder in reversed(_FOLDERS):  # a file in the root itself comes first
        found |= {path.name: path for path in sorted((root / folder).glob("*.json"))}
    return found


def _has_labels(root: Path) -> bool:
    return any(name.startswith(_LABELS) or name in _SPLIT_FILES["test"] for name in _present(root))


def image_folder(root: Path, label_file: Path, names: list[str]) -> Path:
    """Return the folder from which the names of a label file's images start: its own, or another of `_FOLDERS`."""
    folders = (label_file.parent, *(root / folder for folder in _FOLDERS))
    some = names[:: max(len(names) // 10, 1)]
    return max(folders, key=lambda folder: sum((folder / name).is_file() for name in some))
