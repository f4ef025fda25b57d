"""The official splits of nuScenes, by scene name, and splits of a user's own.

Source: nuscenes-devkit, `python-sdk/nuscenes/utils/splits.py`. Of the 850 annotated scenes, 150 are validation; every
other annotated scene is training. v1.0-mini has ten of these scenes and its own split, in which two validation scenes
of the full data set (0553, 0796) are training scenes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

from tflane_jax.datasets.base import SPLITS, Split
from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, load_json


def _scenes(text: str) -> frozenset[str]:
    ends = [[int(end) for end in part.split("-")] for part in text.split()]
    return frozenset(f"scene-{number:04d}" for span in ends for number in range(span[0], span[-1] + 1))


VAL = _scenes(
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
"""The 150 validation scenes of v1.0-trainval."""
TEST = _scenes(
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 844-846 "
    "932-933 935-943 1026-1043"
)
"""The 150 scenes of v1.0-test; their annotations are not public."""
MINI_TRAIN = _scenes("61 553 655 757 796 1077 1094 1100")
MINI_VAL = _scenes("103 916")


MISPLACED = _scenes("499 501-502 515 517")
"""Training scenes that do not fit the map, by the devkit's known issues: poses are off, or outside of the mapped area.
OpenLane-V2 and StreamMapNet leave out all but 0501, MapTR none."""


def official_split(scene: str, *, mini: bool) -> Split | None:
    """Return the split of a scene by its name, in v1.0-mini or in the full data set; None if `mini` does not have it.

    A name that is neither a validation nor a test scene is training.
    """
    if mini:
        return "train" if scene in MINI_TRAIN else "val" if scene in MINI_VAL else None
    return "val" if scene in VAL else "test" if scene in TEST else "train"


def split_scenes(
    names: Iterable[str],
    split: Split,
    *,
    mini: bool,
    file: Path | None = None,
    misplaced: Literal["keep", "drop"] = "keep",
) -> list[str]:
    """Return the scenes of a split, sorted.

    Args:
        names: scenes of the tables.
        split: train, val or test.
        mini: whether the tables are v1.0-mini's.
        file: JSON file {"train": [scene names], "val": [...], ...} in place of the official splits.
        misplaced: what becomes of `MISPLACED` scenes.

    Raises:
        UserError: the file is malformed, lacks the split, names a scene that the tables lack or one of the training
            split in another one; or the split is empty.
    """
    names = sorted(names)
    if file is None:
        found = [name for name in names if official_split(name, mini=mini) == split]
    else:
        found = sorted(listed_scenes(file, split))
        _check_apart(file)
        if missing := set(found) - set(names):
            raise UserError(f"{file}: split {split} names {min(missing)}, which the tables do not have")
    if misplaced == "drop":
        found = [name for name in found if name not in MISPLACED]
    if not found:
        counts = {one: sum(official_split(name, mini=mini) == one for name in names) for one in SPLITS}
        have = ", ".join(f"{one} ({count} scenes)" for one, count in counts.items() if count) or "none of any split"
        raise UserError(
            f"split {split} has no scene in these tables, which hold {have if file is None else len(names)}: choose "
            "another split, name a file of splits, or, where tables of several versions lie side by side, the folder "
            "of those meant, such as ROOT/v1.0-test"
        )
    return found


def listed_scenes(file: Path, split: Split) -> Sequence[str]:
    """Return the scenes of a split as a file lists them; raises UserError for a file that does not."""
    scenes = items(load_json(Path(file)), split, str(file))
    if not all(isinstance(scene, str) for scene in scenes) or len(set(scenes)) != len(scenes):
        raise UserError(f"{file}: split {split} must be a list of different scene names")
    return scenes


def _check_apart(file: Path) -> None:
    """Raise UserError where a scene is trained on and tested; validation and test split may be the same."""
    content = load_json(Path(file))
    lists = {split: listed_scenes(file, split) for split in SPLITS if split in content}
    for split in lists.keys() - {"train"}:
        if both := set(lists.get("train", ())) & set(lists[split]):
            raise UserError(f"{file}: {min(both)} is in train and in {split}: give each scene to one of them")
