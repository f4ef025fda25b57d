"""Plausibility checks of a drive: jumps, a map of another place, boxes too far away, vehicles that drive sideways.

Such files would give examples without lanes or with senseless traffic, and no error. A line of a map with one
coordinate of thousands of kilometres would fill the memory with its points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import pose_yaw, transform_points, wrap_angle
from tflane_jax.scene import Example, RoadUser
from tflane_jax.scene.logs import Tracks

# Metres per second, and metres.
_FASTEST, _JITTER = 70.0, 0.5
FAR = 200.0
"""Metres from a vehicle to the nearest lane. Parking lots are not on the map; another city is farther."""
FARTHEST_STEP = 10_000.0
"""Metres from one point of a map's line to the next, or along one of its arcs; more is a damaged number."""
FARTHEST_LANE = 10_000.0
"""Metres from the vehicle to a point of a lane; more are coordinates of a map."""
FARTHEST, MOST_PIXELS = 1e8, 1e6
"""Metres of a coordinate, and pixels of a camera matrix; more would be infinite in float32, or senseless."""
LARGEST_IMAGE = 20_000
"""Pixels of a side of an image; arrays are made for the sizes that a calibration names."""
LARGEST_DISTORTION = 100.0
"""Largest of OpenCV's coefficients; with more, no pixel of an image would be left."""
# Metres from the vehicle to a box; the annotators of nuScenes saw some 150 m far.
_UNSEEN = 500.0

# Metres per second; radians between heading and motion, whose median is 15 degrees at most for each moving vehicle of
# nine recorded drives; how many vehicles must move, each in as many intervals.
_MOVING, _SIDEWAYS, _FEWEST = 3.0, np.radians(45.0), 3

SHORTEST, LONGEST = 0.002, 60.0
"""Seconds between the frames of a drive: less or more means that its times are in another unit."""

T = TypeVar("T")


def check_motion(position: Float[np.ndarray, "f d"], times_ns: Int[np.ndarray, " f"], where: Sequence[str]) -> None:
    """Raise UserError, which names the place, where a vehicle jumps from one key frame to the next."""
    metres, seconds = np.linalg.norm(np.diff(position, axis=0), axis=-1), np.diff(times_ns) / 1e9
    if (jumps := metres > _FASTEST * seconds + _JITTER).any():
        i = int(jumps.argmax())
        raise UserError(
            f"{where[i + 1]}: the vehicle is {metres[i]:.0f} m from its place {seconds[i]:.2g} s before: pose or "
            "timestamp is wrong"
        )


def missing_frames(times_ns: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f-1"]:
    """Return how many frames are missing in each interval; one shorter than 1.5 times the median lacks none.

    That is 0, or -1 for an interval of at most half the median.
    """
    steps = np.diff(times_ns)
    return np.rint(steps / np.median(steps)).astype(int) - 1 if len(steps) else steps


def check_interval(times_ns: Int[np.ndarray, " f"], unit: str, where: str) -> None:
    """Raise UserError, which names the place, where the times of frames cannot be in the unit of their format.

    A drive in microseconds instead of nanoseconds would have an empty traffic flow: its history would look back a
    thousand times as many frames.
    """
    if len(times_ns) < 2:
        return
    seconds = float(np.median(np.diff(times_ns))) / 1e9
    if not SHORTEST <= seconds <= LONGEST:
        raise UserError(f"{where}: its frames are {seconds:.2g} s apart: are its times in {unit}?")


def check_place(lanes: Sequence[Float[np.ndarray, "_ d"]], position: Float[np.ndarray, "f 2"], where: str) -> None:
    """Raise UserError if a vehicle never comes near a lane: the map is empty, or of another place.

    Args:
        lanes: centerlines, at least those within `FAR` of the vehicle.
        position: of the vehicle.
        where: what is checked, for the message.
    """
    apart = [float(np.linalg.norm(position[:, None] - line[:, :2], axis=-1).min()) for line in lanes]
    if min(apart, default=np.inf) > FAR:
        raise UserError(
            f"{where}: the vehicle never comes within {FAR:.0f} m of a lane: the map is empty or of another place"
        )


def check_steps(line: Float[np.ndarray, "n d"], where: str) -> None:
    """Raise UserError, which names the place, where two successive points of a map's line are impossibly far apart."""
    with np.errstate(over="ignore"):
        metres = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=-1)
    if (far := ~(metres <= FARTHEST_STEP)).any():
        i = int(far.argmax())
        raise UserError(f"{where}: points {i} and {i + 1} are {metres[i] / 1e3:g} km apart: restore the file")


def area_between(left: Float[np.ndarray, "n d"], right: Float[np.ndarray, "m d"]) -> float:
    """Return the area between two boundaries, m2; negative if the left one is to the right, in driving direction."""
    ring = np.concatenate([right, left[::-1]])[:, :2]
    x, y = (ring - ring[0]).T  # city coordinates are large
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2.0)


def first_twice(names: Sequence[T]) -> T | None:
    """Return the first name that occurs twice, or None."""
    seen: set[T] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None


def check_distance(position: Float[np.ndarray, "n 3"], where: Sequence[str]) -> None:
    """Raise UserError, which names the place, for a box (vehicle's frame) that its sensors cannot have seen."""
    metres = np.linalg.norm(position[:, :2], axis=-1)
    if (metres > _UNSEEN).any():
        i = int(metres.argmax())
        raise UserError(f"{where[i]}: the box is {metres[i]:.0f} m from the vehicle: box or pose is wrong")


def check_lanes(dataset: str, index: int, example: Example) -> None:
    """Raise UserError where lanes of an example are no numbers, or too far away to be in the frame of the vehicle."""
    for name, lanes in (("lanes", example.lanes), ("segments", example.segments)):
        points = np.asarray(lanes.points)[np.asarray(lanes.valid)]
        if not np.isfinite(points).all():
            raise UserError(f"{dataset}: {name} of example {index} have a point that is not finite")
        if (farthest := np.abs(points).max(initial=0.0)) > FARTHEST_LANE:
            raise UserError(
                f"{dataset}: {name} of example {index} reach {farthest / 1e3:.3g} km from the vehicle: their points "
                "must be in its own frame in metres, x ahead and y to the left, not in coordinates of a map"
            )


def check_headings(
    tracks: Tracks, global_from_frame: Float[np.ndarray, "f 4 4"], times_ns: Int[np.ndarray, " f"], where: str
) -> None:
    """Raise UserError, which names the place, where most moving vehicles do not head in the direction of their motion.

    Rotations in another order, direction or unit, or axes that are swapped, would turn the lanes that traffic flow
    tells of. Some vehicles reverse; with fewer than three that move, nothing is said.
    """
    center = transform_points(global_from_frame, tracks.position)[..., :2]
    heading = tracks.yaw + pose_yaw(global_from_frame)[:, None]
    step, seconds = np.diff(center, axis=0), np.diff(times_ns)[:, None] / 1e9
    vehicle = np.isin(tracks.category, (RoadUser.CAR, RoadUser.TRUCK, RoadUser.BUS))
    moving = tracks.valid[1:] & tracks.valid[:-1] & vehicle & (np.linalg.norm(step, axis=-1) > _MOVING * seconds)
    apart = np.abs(wrap_angle(heading[:-1] - np.arctan2(step[..., 1], step[..., 0])))
    of_each = [np.median(apart[moving[:, k], k]) for k in np.flatnonzero(moving.sum(0) >= _FEWEST)]
    sideways = int((np.array(of_each) > _SIDEWAYS).sum())
    if len(of_each) >= _FEWEST and sideways > len(of_each) / 2:
        raise UserError(
            f"{where}: {sideways} of {len(of_each)} moving vehicles do not head where they move (the median of all is "
            f"{np.degrees(np.median(of_each)):.0f} degrees off): are the rotations in another order, direction or unit?"
        )
