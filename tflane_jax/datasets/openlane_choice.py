"""Subset and image preset of a folder of OpenLane-V2, from its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tflane_jax.datasets.base import SPLITS, Split
from tflane_jax.datasets.openlane_frames import SUBSETS, SubsetName, info_path, read_frame, subset_of_frame
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, TOPONET_SUBSET_B, ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FrameKey


def subset_of(root: Path) -> SubsetName:
    """Return the subset of the only split file in a folder; without one or with both, that of the first frames there.

    The official folder has both files, and often the frames of one subset. Where nothing tells, it is A.
    """
    named: list[SubsetName] = [name for name, subset in SUBSETS.items() if (root / subset.data_dict).is_file()]
    if len(named) == 1:
        return named[0]
    for split in SPLITS:
        if (key := _first_frame(root, split)) is not None and (subset := subset_of_frame(root, key)) is not None:
            return subset
    return "A"


def preset_of(root: Path, split: Split, subset: SubsetName) -> ImageConfig:
    """Return TopoNet's preset for the images of a subset; with all rows, if the front image has another size.

    `tflane data export` writes images of other sizes than the official ones.
    """
    preset = TOPONET_SUBSET_A if subset == "A" else TOPONET_SUBSET_B
    if (key := _first_frame(root, split)) is None:
        return preset
    suffix = next((names.suffix for names in (CENTERLINE, SEGMENT) if info_path(root, key, names.suffix).is_file()), "")
    try:
        front = read_frame(root, key, subset, suffix).cameras[0]
        official = front is None or read_image(front.image).shape[1::-1] == SUBSETS[subset].sizes[0]
    except UserError:  # reported when the frames are read
        official = True
    return preset if official else replace(preset, front_rows=None)


def _first_frame(root: Path, split: Split) -> FrameKey | None:
    """Return a frame of the first segment of a split that has one on disk."""
    for segment in sorted((root / split).glob("*")):
        for path in (segment / "info").glob("*.json"):
            return FrameKey(split, segment.name, path.stem.removesuffix("-ls"))
    return None
