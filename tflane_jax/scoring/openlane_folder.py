"""Which annotation files of OpenLane-V2's folder are the truth of some predictions.

Source: docs/reference/data_formats.md, section 2. The folder may hold both subsets; the official evaluation is of one.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from pathlib import Path

from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.files.fields import load_json
from tflane_jax.files.openlane import DATA_DICT, FieldNames, FrameKey, frames_of, info_files
from tflane_jax.files.wording import named


def annotation_files(
    folder: Path, names: FieldNames, predicted: Collection[FrameKey], shown: Path
) -> dict[FrameKey, Path]:
    """Return the annotations of one task in the dataset's folder, or in that of one split.

    Args:
        folder: absolute, because the names of split and segment are taken from the path.
        names: of the task.
        predicted: frames whose splits, and whose subset of those that the split files name, are wanted; all if empty.
        shown: the folder as messages name it.

    Warns (`LeftOutWarning`) of frames that the subset's split file names and the folder lacks.

    Raises:
        UserError: there are none, or one is there twice.
    """
    splits = {key.split for key in predicted}
    found = _below(folder, splits)
    stems = {file: file.stem.removesuffix("-ls") for file in found}
    wanted, files, unnamed = _subset(folder, predicted), {}, 0
    for file, stem in stems.items():
        if file.stem != stem + names.suffix:
            continue
        segment = file.parent.parent
        key = FrameKey(segment.parent.name, segment.name, stem)
        if key in files:
            raise UserError(f"{shown}: frame {named(key)} is there twice: {files[key]} and {file}")
        if wanted is None or key in wanted:
            files[key] = file
        else:
            unnamed += 1
    if unnamed and not files:
        raise UserError(
            f"{shown} holds {unnamed} annotations of this task, and its split file ({DATA_DICT}*.json) names none of "
            "them: expected lists of <timestamp>.json by split and segment in it"
        )
    if not files:
        other = f"; it has {len(stems)} files of the other task" if stems else ""
        of = f" of split {', '.join(sorted(splits))}" if splits else ""
        raise UserError(
            f"{shown} holds no annotations{of}: expected <split>/<segment>/info/<timestamp>{names.suffix}.json in it"
            f"{other}"
        )
    if lacking := sorted((wanted or set()) - files.keys()):
        warnings.warn(
            f"{len(lacking)} of {len(wanted or ())} frames that the split file names have no annotation in {shown}, "
            f"such as {named(lacking[0])}: the scores are not those of the whole subset",
            LeftOutWarning,
            stacklevel=2,
        )
    return files


def _below(folder: Path, splits: Collection[str]) -> list[Path]:
    """Return the annotations of some splits (none: of all) in the dataset's folder, or in that of one split."""
    if not splits:
        return sorted(info_files(folder))
    # Not `folder / split`: that name comes from the predictions, and "/" is one.
    below = [found for found in folder.iterdir() if found.name in splits and found.is_dir()] or [folder]
    files = (file for each in below for file in info_files(each))
    return sorted(file for file in files if file.parent.parent.parent.name in splits)


def _subset(folder: Path, predicted: Collection[FrameKey]) -> set[FrameKey] | None:
    """Return the frames of the split file that is predicted; None where none tells.

    It is the one that names the predicted frames and no others, such as an own file; else the only official one that
    names any of their segments.
    """
    scenes, splits, subsets = {key.scene for key in predicted}, {key.split for key in predicted}, []
    for file in (file for each in (folder, folder.parent) for file in sorted(each.glob("data_dict_*.json"))):
        content = load_json(file)
        there = [split for split in sorted(splits) if isinstance(content, Mapping) and split in content]
        frames = {key for split in there for key in frames_of(content, split, str(file))}
        if frames and frames == set(predicted):
            return frames
        if file.name.startswith(DATA_DICT) and scenes & {key.scene for key in frames}:
            subsets.append(frames)
    return subsets[0] if len(subsets) == 1 else None
