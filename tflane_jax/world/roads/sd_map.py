"""Simulated SD maps: coarse road lines of a navigation map, placed by an erroneous vehicle pose.

An SD map has three kinds of error, each with its own setting: few vertices (`tolerance`), inexact survey (`survey`) and
a GNSS pose error (`translation`, `yaw_deg`). Lines are cut at the perception range around the erroneous pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import (
    BevGrid,
    PerceptionRange,
    clip_to_range,
    invert_pose,
    nearest_lines,
    resample_lines,
    simplify,
    transform_points,
)
from tflane_jax.geometry.poses import yaw_pose
from tflane_jax.limits import Count, Positive, PositiveOrZero, counted
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.scene.logs import Log

# Random streams of a log's seed; `world.bev.sensor` uses 1 and 2.
_SURVEY_STREAM, _GNSS_STREAM = 31, 32
# Number of waves in the survey error and their typical length, metres: errors of neighbouring roads agree.
_WAVES, _WAVE_LENGTH = 16, 120.0


@dataclass(frozen=True)
class SdMapConfig:
    """Size and errors of an SD map; without errors its lines lie in the middle of the roads.

    Attributes:
        lines: capacity R; the nearest lines are kept.
        points: on each line, P, equally spaced (SMERF: 11).
        range: box at which lines are cut, ego frame.
        tolerance: largest distance of a dropped vertex from the simplified line, metres.
        survey: standard deviation of the error of the map's points along each axis, metres. It changes slowly from
            place to place, so roads that meet still meet.
        translation: standard deviation of the GNSS receiver's error along each axis, metres.
        yaw_deg: standard deviation of the error of its heading, degrees.
        drift_s: decorrelation time of position and heading errors, seconds: the error is
            sigma (a cos wt + b sin wt), w = pi / (2 drift_s), with a and b drawn once for each scene.
        crossings: whether pedestrian crossings are lines of the map.
    """

    lines: Count = 24
    points: Annotated[int, counted(2)] = 11
    range: PerceptionRange = BevGrid().range
    tolerance: PositiveOrZero = 1.0
    survey: PositiveOrZero = 1.5
    translation: PositiveOrZero = 0.0
    yaw_deg: PositiveOrZero = 0.0
    drift_s: Positive = 30.0
    crossings: Literal["include", "exclude"] = "include"


def make_sd_map(log: Log, keyframe: int, config: SdMapConfig) -> tuple[SdMap, int]:
    """Return the SD map of a key frame and the number of lines dropped for lack of capacity (the farthest).

    Seeded by the log: the map is the same in all frames of a log; only the vehicle's pose error changes.

    Raises:
        UserError: the log's map has no roads.
    """
    # A map of roads is flat; so is where the vehicle believes it is.
    moment = (log if log.relief is None else log.relief.level).keyframes[keyframe]
    seconds = (moment.timestamp_ns - int(log.timestamps_ns[0])) * 1e-9
    surveyed, category = sd_lines(log, config)
    sizes = np.cumsum([len(line) for line in surveyed])[:-1]
    points = np.concatenate(surveyed)
    error = gnss_error(log.seed, seconds, config)
    zero = np.zeros(())
    believed = moment.global_from_ego @ yaw_pose(zero, zero, error[2])
    believed[:2, 3] += error[:2]
    points = transform_points(invert_pose(believed), np.pad(points, ((0, 0), (0, 1))))[:, :2]
    return pack_lines(
        np.split(points, sizes), category, capacity=config.lines, points=config.points, range_=config.range
    )


def sd_lines(log: Log, config: SdMapConfig) -> tuple[list[Float[np.ndarray, "_ 2"]], list[SdCategory]]:
    """Return the lines of a log's SD map in global metres, with the survey's error, and their categories.

    Raises:
        UserError: the log's map has no roads.
    """
    if not log.map.roads:
        raise UserError(
            f"{log.source} {log.name} knows lanes but no roads, of which an SD map could be made: leave sd_map of "
            "ExampleConfig None, or read an SD map with tflane_jax.datasets.geojson"
        )
    rings = log.map.crossings if config.crossings == "include" else ()
    lines = [simplify(road[:, :2], config.tolerance) for road in log.map.roads]
    lines += [crossing_line(ring[:, :2]) for ring in rings]
    sizes = np.cumsum([len(line) for line in lines])[:-1]
    points = np.concatenate(lines)
    points = points + config.survey * survey_error(points, log.seed)
    category = [SdCategory.ROAD] * len(log.map.roads) + [SdCategory.CROSSWALK] * len(rings)
    return np.split(points, sizes), category


def pack_lines(
    lines: Sequence[Float[np.ndarray, "_ 2"]],
    category: Sequence[int],
    *,
    capacity: int,
    points: int,
    range_: PerceptionRange,
) -> tuple[SdMap, int]:
    """Return lines cut at a range and resampled as an SD map, and the number of dropped pieces (the farthest).

    Args:
        lines: ego frame, metres, none empty.
        category: of each, `SdCategory`.
        capacity: lines R of the map; pieces keep their order.
        points: P on each, equally spaced.
        range_: where lines are cut; a line that leaves it and comes back is several pieces.
    """
    pieces = [
        (piece, label) for line, label in zip(lines, category, strict=True) for piece in clip_to_range(line, range_)
    ]
    sd_map = SdMap.empty(capacity, points)
    if not pieces:
        return sd_map, 0
    found = resample_lines([piece for piece, _ in pieces], points)
    kept = nearest_lines([piece for piece, _ in pieces], capacity)
    n = len(kept)
    sd_map.points[:n] = found[kept]
    sd_map.category[:n] = np.array([label for _, label in pieces])[kept]
    sd_map.valid[:n] = True
    return sd_map, len(pieces) - n


def crossing_line(ring: Float[np.ndarray, "5 2"]) -> Float[np.ndarray, "2 2"]:
    """Return the center line of a pedestrian crossing of the built-in world, from kerb to kerb."""
    return np.stack([0.5 * (ring[0] + ring[3]), 0.5 * (ring[1] + ring[2])])


def survey_error(points: Float[np.ndarray, "n 2"], seed: int) -> Float[np.ndarray, "n 2"]:
    """Return the error of a map at some places (global, metres): a smooth random field of standard deviation 1."""
    rng = np.random.default_rng([seed, _SURVEY_STREAM])
    wave = rng.normal(0.0, 2 * math.pi / _WAVE_LENGTH, (_WAVES, 2))
    phase, amplitude = rng.uniform(0.0, 2 * math.pi, _WAVES), rng.normal(size=(_WAVES, 2))
    return math.sqrt(2 / _WAVES) * np.cos(points @ wave.T + phase) @ amplitude


def gnss_error(seed: int, seconds: float, config: SdMapConfig) -> Float[np.ndarray, "3"]:
    """Return the receiver's error of x, y (global, metres) and heading (radians) at a time of a scene."""
    first, second = np.random.default_rng([seed, _GNSS_STREAM]).normal(size=(2, 3))
    turn = 0.5 * math.pi * seconds / config.drift_s
    sigma = np.array([config.translation, config.translation, math.radians(config.yaw_deg)])
    return sigma * (first * math.cos(turn) + second * math.sin(turn))
