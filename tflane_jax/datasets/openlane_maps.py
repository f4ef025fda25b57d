"""A segment of OpenLane-V2 as a map for the built-in world: lanes of all its frames, joined in the global frame.

A frame's annotation holds the lanes within +-50 m x +-25 m of the vehicle, cut at that border, and their topology. From
frame to frame a lane is followed by where it lies: files of other origin may number lanes anew in every frame. Its
pieces are joined, and so are the frames' topologies. Any folder of this form will do:

    <segment>/info/<timestamp>.json, or -ls.json     pose and annotation of each frame

Lane-segment files (-ls) tell boundaries, markings and road edges. Centerline files tell none of these: lanes get a
width of 3.5 m. Crossings are left out; cameras, images and traffic elements are not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.identities import pairs_within
from tflane_jax.datasets.lane_outlines import LaneOutline, boundaries
from tflane_jax.datasets.openlane_annotation import Annotation, read_annotation
from tflane_jax.datasets.openlane_frames import frame_pose
from tflane_jax.datasets.plausible import FARTHEST_STEP, check_motion
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_json, member
from tflane_jax.files.openlane import CENTERLINE, SEGMENT
from tflane_jax.geometry import line_distances, transform_points
from tflane_jax.geometry.polylines import arc_length, resample_lines, sample_at, without_repeats
from tflane_jax.scene import AreaType, LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.roads.road_map import RoadMap

# Distance across the road up to which frames are complete, metres.
COMPLETE = 25.0
# Lines whose mean distance is less are one line, metres; the ends of pieces differ by less than half as much.
_SAME = 0.75
# A point this near to the one before repeats it, metres.
_SAME_POINT = 1e-3
_POINTS = 41
# Timestamps of Argoverse 2 are nanoseconds, of more digits; those of nuScenes microseconds.
_NANOSECONDS = 10**17


def segment_files(folder: Path) -> tuple[Path, ...]:
    """Return the frames' files of a segment by time: those with lane segments, if there are any.

    Args:
        folder: `info`, with a file for each frame.
    """
    files = {suffix: [] for suffix in (SEGMENT.suffix, CENTERLINE.suffix)}
    for path in sorted(folder.glob("*.json")):
        suffix = SEGMENT.suffix if path.stem.endswith(SEGMENT.suffix) else CENTERLINE.suffix
        if path.stem.removesuffix(suffix).isdecimal():
            files[suffix].append(path)
    return tuple(sorted(files[SEGMENT.suffix] or files[CENTERLINE.suffix], key=_time))


def _time(path: Path) -> int:
    return int(path.stem.removesuffix(SEGMENT.suffix))


def read_segment(files: Sequence[Path]) -> RoadMap:
    """Read the map of a segment; `files` as from `segment_files`.

    Raises UserError, which names file and field, for a frame that is damaged or has no annotation, for a vehicle that
    jumps, and where no frame has a lane.
    """
    lanes, edges, poses = _Lines(), _Lines(), []
    for path in files:
        names = SEGMENT if path.stem.endswith(SEGMENT.suffix) else CENTERLINE
        content, where = load_json(path), str(path)
        pose = frame_pose(member(content, "pose", where), f"{where}: pose")
        if content.get("annotation") is None:
            raise UserError(f"{where} has no annotation, as in the test split: take another segment")
        found = read_annotation(content["annotation"], names, where)
        _check_lengths(found, where)
        lanes.step(_global(found, pose), found.is_connector, np.stack([found.left_type, found.right_type], -1))
        lanes.connect(found.successor)
        border = [
            line for line, kind in zip(found.areas, found.area_category, strict=True) if kind == AreaType.ROAD_BOUNDARY
        ]
        edges.step([(transform_points(pose, line),) for line in border])
        poses.append(pose)
    places = np.stack(poses)[:, :2, 3]
    latest = max(files, key=_time)
    tick = 1 if _time(latest) >= _NANOSECONDS else 1000
    if tick * _time(latest) > np.iinfo(np.int64).max:
        raise UserError(f"{latest} is not named after its time in nanoseconds or microseconds: take the file out")
    times = np.array([tick * _time(path) for path in files], np.int64)
    check_motion(places, times, [str(path) for path in files])
    segments = dict(_lane_segments(lanes, has_sides=files[0].stem.endswith(SEGMENT.suffix)))
    segment = files[0].parent.parent
    if not segments:
        raise UserError(f"{segment}: no frame has a lane: take another segment")
    border = tuple(parts[0] for parts in edges.parts)
    return RoadMap(map_name(segment), "openlane_v2", VectorMap(segments, (), border), places, COMPLETE)


def _check_lengths(found: Annotation, where: str) -> None:
    """Raise UserError for a line that is impossibly long, which would become millions of points."""
    lines = (*found.lines, *(found.left or ()), *(found.right or ()), *found.areas)
    if (longest := max((float(arc_length(line)[-1]) for line in lines), default=0.0)) > FARTHEST_STEP:
        raise UserError(f"{where}: a line is {longest / 1e3:.0f} km long, in a frame of some 100 m: restore the file")


def map_name(segment: Path) -> str:
    """Return the name of a segment's map: split and number."""
    return f"{segment.parent.name}-{segment.name}"


def _global(found: Annotation, pose: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return centerline, left and right of each lane, global metres."""
    sides = (found.lines, found.left or found.lines, found.right or found.lines)
    return [tuple(transform_points(pose, line) for line in three) for three in zip(*sides, strict=True)]


@dataclass
class _Lines:
    """Groups of lines followed from frame to frame: centerline, left and right of a lane, or one road edge.

    The first line of a group decides which groups of two frames are the same.

    Attributes:
        parts: lines of each group found so far.
        connector: whether each is in an intersection.
        kinds: (left, right) `LineType` of each.
        after: numbers of the groups that continue each.
    """

    parts: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    connector: list[bool] = field(default_factory=list)
    kinds: list[tuple[int, int]] = field(default_factory=list)
    after: list[set[int]] = field(default_factory=list)
    _before: list[np.ndarray] = field(default_factory=list)
    _numbers: dict[int, int] = field(default_factory=dict)  # by row of the latest frame

    def step(
        self,
        found: Sequence[tuple[np.ndarray, ...]],
        connector: Sequence[bool] | np.ndarray = (),
        kinds: Sequence[Sequence[int]] | np.ndarray = (),
    ) -> None:
        """Take the groups of the next frame, global metres; one whose first line has no length is passed over."""
        found = [tuple(without_repeats(line, _SAME_POINT) for line in parts) for parts in found]
        rows = [row for row, parts in enumerate(found) if len(parts[0]) > 1]
        now, before = [found[row][0] for row in rows], list(self._numbers.values())
        known = same_lines(now, self._before)
        numbers = {}
        for place, row in enumerate(rows):
            parts = found[row]
            if place in known:
                number = before[known[place]]
                pairs = zip(self.parts[number], parts, strict=True)
                self.parts[number] = tuple(joined(before_, after) for before_, after in pairs)
            else:
                number = len(self.parts)
                self.parts.append(parts)
                self.connector.append(bool(len(connector) and connector[row]))
                self.kinds.append((int(kinds[row][0]), int(kinds[row][1])) if len(kinds) else (0, 0))
                self.after.append(set())
            numbers[row] = number
        self._before, self._numbers = now, numbers

    def connect(self, successor: np.ndarray) -> None:
        """Add the topology (n, n) of the latest frame."""
        for i, j in np.argwhere(successor).tolist():
            a, b = self._numbers.get(i), self._numbers.get(j)
            if a is not None and b is not None and a != b:
                self.after[a].add(b)


def _lane_segments(lanes: _Lines, *, has_sides: bool) -> Iterator[tuple[int, LaneSegment]]:
    """Yield the lanes by number, without those that lie wholly on a longer one.

    Args:
        lanes: of all frames.
        has_sides: whether the files tell boundaries; lanes without any get those of a lane of the usual width.
    """
    keep = _without_copies([parts[0] for parts in lanes.parts])
    lines = {i: lanes.parts[i][0] for i, number in enumerate(keep) if number == i and len(lanes.parts[i][0]) > 1}
    after: dict[int, set[int]] = {i: set() for i in lines}
    for i, following in enumerate(lanes.after):
        after.setdefault(keep[i], set()).update(keep[j] for j in following)
    # A side without length is none.
    plain = {i: _plain(line) for i, line in lines.items() if not has_sides or min(map(len, lanes.parts[i])) < 2}
    beside = boundaries({i: LaneOutline(line[:, :2], None) for i, line in plain.items()}, {})
    for i, line in lines.items():
        left, right = lanes.parts[i][1:]
        if i in plain:
            height = plain[i][:, 2] if has_sides else np.zeros(len(plain[i]))
            left, right, line = (np.column_stack([one[:, :2], height]) for one in (*beside[i], plain[i]))
        yield (
            i,
            LaneSegment(
                id=i,
                centerline=line,
                left=left,
                right=right,
                left_type=LineType(lanes.kinds[i][0]),
                right_type=LineType(lanes.kinds[i][1]),
                is_intersection=lanes.connector[i],
                successors=tuple(sorted(j for j in after[i] if j in lines and j != i)),
            ),
        )


def same_lines(now: Sequence[np.ndarray], before: Sequence[np.ndarray]) -> dict[int, int]:
    """Return the line of the frame before that each line continues, by numbers; new lines are left out.

    A line may be cut shorter: the smaller one of the mean distances from one to the other counts.
    """
    if not len(now) or not len(before):
        return {}
    ours, theirs = (resample_lines(list(lines), _POINTS) for lines in (now, before))
    there, place = line_distances(ours[:, None], theirs)
    back = line_distances(theirs[:, None], ours)[0].mean(-1).T
    apart = np.minimum(there.mean(-1), back) + 1e-3 * np.maximum(there.mean(-1), back)
    # The same direction.
    apart = np.where(place[..., -1] >= place[..., 0], apart, 1e6)
    return pairs_within(apart, _SAME)


def joined(before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "k 3"]:
    """Return the union of two pieces of a line: the later one, and what the earlier one has beyond its ends."""
    along = arc_length(before)
    start, end = (_station(before, along, point) for point in (after[0], after[-1]))
    head = before[along < start - 0.5 * _SAME] if start > 0.5 * _SAME else before[:0]
    tail = before[along > end + 0.5 * _SAME] if end < along[-1] - 0.5 * _SAME else before[:0]
    return without_repeats(np.concatenate([head, after, tail]), _SAME_POINT)


def _station(line: np.ndarray, along: np.ndarray, point: np.ndarray) -> float:
    """Return the distance along a line of its place nearest to a point."""
    if len(line) < 2:
        return 0.0
    _, place = line_distances(point[None], line)
    return float(np.interp(place[0], np.arange(len(line)), along))


def _without_copies(lines: Sequence[np.ndarray]) -> Int[np.ndarray, " n"]:
    """Return for each line its own number, or that of a longer line on which it lies wholly."""
    keep = np.arange(len(lines))
    if not len(lines):
        return keep
    dense = resample_lines(list(lines), _POINTS)
    distance, place = line_distances(dense[:, None], dense)
    on = (distance.max(-1) < 0.5 * _SAME) & (place[..., -1] > place[..., 0])
    length = np.array([arc_length(line)[-1] for line in lines])
    for i in np.argsort(length, kind="stable").tolist():
        longer = [j for j in np.flatnonzero(on[i]) if (length[j], j) > (length[i], i)]
        if longer:
            keep[i] = max(longer, key=lambda j: length[j])
    while (keep[keep] != keep).any():
        keep = keep[keep]
    return keep


def _plain(line: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Return a line with points 2 to 4 m apart; of a shorter line its two ends."""
    along = arc_length(line)
    return sample_at(line, np.linspace(0.0, along[-1], max(int(along[-1] // 2) + 1, 2)))
