"""Write any dataset with cameras in OpenLane-V2's layout, for the official repositories and for `openlane_v2`.

Examples have no ids; `datasets.identities` gives lanes, areas and elements ids that last from frame to frame. An
example tells which centerlines, or which lane segments, an element governs; the others follow from what lies on what.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.areas import is_closed
from tflane_jax.datasets.base import Dataset, FrameInfo, Split
from tflane_jax.datasets.identities import Identities
from tflane_jax.datasets.openlane_frames import SUBSETS, SubsetName, info_path
from tflane_jax.datasets.openlane_sd_map import FILE as SD_MAP_FILE
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import replacing
from tflane_jax.files.images import opencv
from tflane_jax.files.openlane import CENTERLINE, DENSE_POINTS, SEGMENT, FrameKey
from tflane_jax.geometry import invert_pose
from tflane_jax.geometry.polylines import resample
from tflane_jax.progress import progress_bar
from tflane_jax.scene import Areas, AreaType, CameraViews, Example, TrafficElements
from tflane_jax.scene.lane_segments import governed_lanes, governed_segments

ImageFormat = Literal["jpg", "png"]
VERSION = "tflane_jax 1"
_JPEG_QUALITY = 95
# Nanoseconds. Timestamps of the built-in world start at zero; this offset gives them as many digits as real ones, so
# that their order as text is their order in time.
_START_NS = {"A": 315_000_000_000_000_000, "B": 1_500_000_000_000_000_000}


def export_openlane_v2(
    datasets: Mapping[Split, Dataset],
    out: Path,
    *,
    images: ImageFormat = "jpg",
    sd_maps: Mapping[Split, Mapping[str, Any]] | None = None,
    progress: bool = True,
) -> Path:
    """Write one dataset per split as a folder of OpenLane-V2, which appears whole or not at all.

    Seven cameras give subset A, six subset B. Scenes become segments in order of appearance; `meta_data` keeps their
    names. Timestamps below a fixed start get it added (see `meta_data.time_offset_ns`).

    Args:
        datasets: their examples have cameras; frames are sorted by scene and time.
        out: folder that does not exist yet or is empty.
        images: "jpg" as official, "png" without loss.
        sd_maps: the content of each scene's `sdmap.json`, by split and name of the scene, see `openlane_sd_map`.
        progress: show a bar with rate and time left.

    Raises:
        UserError: the folder is not empty or cannot be written, a dataset is empty, or its examples do not have six or
            seven cameras.
    """
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out} is not empty: choose another folder")
    with replacing(out) as writing:
        writing.mkdir()
        subset, content = None, {}
        for split, dataset in datasets.items():
            subset = _subset_of(dataset, subset)
            content[split] = _export_split(
                dataset, writing, split, subset, images, (sd_maps or {}).get(split, {}), progress
            )
        if subset is None:
            raise UserError("nothing to export: name at least one split")
        _write_json(writing / SUBSETS[subset].data_dict, content)
    return out


def time_offset(subset: SubsetName, timestamp_ns: int) -> int:
    """Return the nanoseconds that are added to a timestamp; see `export_openlane_v2`."""
    return _START_NS[subset] if timestamp_ns < _START_NS[subset] else 0


def _subset_of(dataset: Dataset, before: SubsetName | None) -> SubsetName:
    """Return the subset that has as many cameras as the examples of a dataset."""
    if len(dataset) == 0:
        raise UserError(f"dataset {dataset.name} has no examples: leave its split out")
    cameras = dataset.example(0).cameras
    if cameras is None:
        raise UserError(f"dataset {dataset.name} has no cameras: OpenLane-V2 needs images (ExampleConfig.cameras)")
    count = len(cameras.valid)
    for name, subset in SUBSETS.items():
        if len(subset.cameras) == count and before in (None, name):
            return name
    raise UserError(
        f"dataset {dataset.name} has {count} cameras: OpenLane-V2 has 7 (subset A) or 6 (subset B), the same for all "
        "splits"
    )


def _export_split(
    dataset: Dataset,
    root: Path,
    split: Split,
    subset: SubsetName,
    images: ImageFormat,
    sd_maps: Mapping[str, Any],
    progress: bool,
) -> dict[str, list[str]]:
    """Write the frames of a split and return its part of the split file."""
    segments: dict[str, list[str]] = {}
    names: dict[str, str] = {}
    ids = Identities()
    for index in progress_bar(range(len(dataset)), f"writing {split}", unit="frame", disable=not progress):
        example, info = dataset.example(index), dataset.info(index)
        if info.scene not in names:
            names[info.scene] = f"{SUBSETS[subset].first_segment[split] + len(names):05d}"
            ids = Identities()
            if info.scene in sd_maps:
                _write_json(root / split / names[info.scene] / SD_MAP_FILE, sd_maps[info.scene])
        offset = time_offset(subset, info.timestamp_ns)
        time = (info.timestamp_ns + offset) // SUBSETS[subset].tick_ns
        key = FrameKey(split, names[info.scene], str(time))
        segments.setdefault(key.segment, []).append(f"{key.timestamp}.json")
        if segments[key.segment][-1] in segments[key.segment][:-1]:
            raise UserError(f"dataset {dataset.name} has two frames of {info.scene} at {info.timestamp_ns} ns")
        assert example.cameras is not None
        ids.step(example)
        frame = _frame(key, info, subset, offset) | {"sensor": _sensors(example.cameras, root, key, subset, images)}
        _write_json(info_path(root, key), frame | {"annotation": centerline_annotation(example, ids)})
        _write_json(info_path(root, key, SEGMENT.suffix), frame | {"annotation": segment_annotation(example, ids)})
    return segments


def _frame(key: FrameKey, info: FrameInfo, subset: SubsetName, offset: int) -> dict[str, Any]:
    return {
        "version": VERSION,
        "segment_id": key.segment,
        "meta_data": {"source": info.source, "source_id": info.scene, "subset": subset, "time_offset_ns": offset},
        "timestamp": int(key.timestamp),
        "pose": _pose(info.global_from_ego),
    }


def _sensors(
    cameras: CameraViews, root: Path, key: FrameKey, subset: SubsetName, images: ImageFormat
) -> dict[str, Any]:
    """Write the images of a frame and return its sensors; cameras without an image are left out."""
    sensors = {}
    for i, name in enumerate(SUBSETS[subset].cameras):
        if not cameras.valid[i]:
            continue
        place = f"{key.split}/{key.segment}/image/{name}/{key.timestamp}.{images}"
        width, height = cameras.size[i]
        _write_image(root / place, np.asarray(cameras.image[i, :height, :width]))
        sensors[name] = {
            "image_path": place,
            "extrinsic": _pose(invert_pose(np.asarray(cameras.camera_from_ego[i], np.float64))),
            "intrinsic": {"K": np.asarray(cameras.intrinsics[i], float).tolist(), "distortion": [0.0, 0.0, 0.0]},
        }
    return sensors


def centerline_annotation(example: Example, ids: Identities) -> dict[str, Any]:
    """Return the annotation of a frame in the centerline flavour, 201 points a line."""
    elements, rows = example.traffic_elements, np.flatnonzero(example.lanes.valid)
    governed = governed_lanes(elements, example.lanes, example.segments)
    return {
        CENTERLINE.lanes: [
            {
                "id": ids.lanes[n],
                "points": _rounded(dense(example.lanes.points[n])),
                "is_intersection_or_connector": bool(example.lanes.is_connector[n]),
            }
            for n in rows.tolist()
        ],
        "traffic_element": _elements(elements, ids),
        CENTERLINE.lane_lane: example.lanes.successor[np.ix_(rows, rows)].astype(int).tolist(),
        CENTERLINE.lane_element: _lane_element(elements, governed[rows]),
    }


def segment_annotation(example: Example, ids: Identities) -> dict[str, Any]:
    """Return the annotation of a frame in the lane-segment flavour, with as many points as the example has."""
    graph, areas, elements = example.segments, example.areas, example.traffic_elements
    governed, rows = governed_segments(elements, graph, example.lanes), np.flatnonzero(graph.valid)
    return {
        SEGMENT.lanes: [
            {
                "id": ids.segments[n],
                "centerline": _rounded(graph.points[n]),
                "left_laneline": _rounded(graph.left[n]),
                "left_laneline_type": int(graph.left_type[n]),
                "right_laneline": _rounded(graph.right[n]),
                "right_laneline_type": int(graph.right_type[n]),
                "is_intersection_or_connector": bool(graph.is_connector[n]),
            }
            for n in rows.tolist()
        ],
        "traffic_element": _elements(elements, ids),
        "area": [
            {"id": ids.areas[n], "category": int(areas.category[n]), "points": _rounded(_outline(areas, n))}
            for n in np.flatnonzero(areas.valid).tolist()
        ],
        SEGMENT.lane_lane: graph.successor[np.ix_(rows, rows)].astype(int).tolist(),
        SEGMENT.lane_element: _lane_element(elements, governed[rows]),
    }


def dense(line: Float[np.ndarray, "p 3"], count: int = DENSE_POINTS) -> Float[np.ndarray, "count 3"]:
    """Return a line with `count` points.

    If `count - 1` is a multiple of the line's segments, every k-th point is one of its own. Otherwise the points are
    equally spaced.
    """
    pieces = len(line) - 1
    if pieces < 1 or (count - 1) % pieces:
        return resample(line, count)
    places = np.linspace(0.0, pieces, count)
    return np.stack([np.interp(places, np.arange(pieces + 1), line[:, i]) for i in range(3)], -1)


def _outline(areas: Areas, row: int) -> Float[np.ndarray, "p 3"]:
    """Return the outline of an area: of a crossing that is given by its two long sides, the ring of their ends."""
    points = np.asarray(areas.points[row])
    if areas.category[row] != AreaType.PEDESTRIAN_CROSSING or is_closed(points):
        return points
    half = len(points) // 2
    return points[[0, half - 1, half, -1, 0]]


def _lane_element(elements: TrafficElements | None, governed: Bool[np.ndarray, "k e"]) -> list[list[int]]:
    """Return which valid elements govern each lane, as 0 and 1."""
    return governed[:, [] if elements is None else np.flatnonzero(elements.valid)].astype(int).tolist()


def _elements(elements: TrafficElements | None, ids: Identities) -> list[dict[str, Any]]:
    if elements is None:
        return []
    return [
        {
            "id": ids.elements[e],
            "category": int(elements.category[e]),
            "attribute": int(elements.attribute[e]),
            "points": _rounded(elements.box[e]),
        }
        for e in np.flatnonzero(elements.valid).tolist()
    ]


def _pose(pose: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    return {"rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist()}


def _rounded(values: np.ndarray) -> list:
    """Return plain numbers to a tenth of a millimetre."""
    return np.round(np.asarray(values, np.float64), 4).tolist()


def _write_image(path: Path, image: np.ndarray) -> None:
    cv2 = opencv()
    path.parent.mkdir(parents=True, exist_ok=True)
    options: Sequence[int] = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if path.suffix == ".jpg" else []
    done, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done
    path.write_bytes(data.tobytes())


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
