"""Photographs of roads with a fiducial marker that is partly hidden, dirty, shadowed or blurred."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from tflane_jax.files.images import PHOTO_SUFFIXES, read_image
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.scene.marker_patterns import MarkerFamily, board_cells, board_size, cells_across, marker_count
from tflane_jax.world.roads.markers import marker_pose

FAMILY = MarkerFamily.ARUCO_5X5_100
DISTANCES = (10.0, 20.0, 30.0, 40.0)
DAMAGE = (
    "none",
    "bar 2 %",
    "bar 10 %",
    "bar 20 %",
    "corner",
    "side 25 %",
    "dirt",
    "shadow 65 %",
    "leaf shadows",
    "blur",
)
# Pixels of a cell on the painted board, and cells around the board that damage may cover too.
_FINE, _AROUND = 16, 2
# Horizontal focal length as a fraction of the image width, as nuScenes' front camera has it.
_FOCAL = 0.79
# The part of a photograph that is searched reaches this far around a board, in addition to its own size, pixels.
_PART = 120
# Ego frame (x ahead, y left, z up) to camera frame.
CAMERA = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Composite:
    """A photograph with a board.

    Attributes:
        image: RGB.
        marker_id, outline: of the board; pixels.
        ids: that are possible; None for all of the family.
        camera: intrinsics.
        distance: metres.
        damage: one of `DAMAGE`.
    """

    image: np.ndarray
    marker_id: int
    outline: np.ndarray
    ids: tuple[int, ...] | None
    camera: np.ndarray
    distance: float
    damage: str


def photographs() -> list[np.ndarray]:
    """Return photographs of roads, or invented pictures where the shared data are absent."""
    root = Path(os.environ.get("TFLANE_SHARED", Path(__file__).parents[2] / "shared")) / "data"
    found = [
        path
        for folder in ("nuscenes_keyframe", "tusimple")
        for path in sorted((root / folder).rglob("*"))
        if path.suffix.lower() in PHOTO_SUFFIXES
    ]
    if not found:
        print(f"no photographs below {root}: invented pictures instead")
        return [_invented(np.random.default_rng(seed)) for seed in range(6)]
    return [read_image(path) for path in found]


def _invented(rng: np.random.Generator) -> np.ndarray:
    image = np.full((900, 1600, 3), 120, np.uint8)
    for _ in range(150):
        (x, y), (w, h) = rng.integers(0, (1600, 900)), rng.integers(5, 200, 2)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 255, 3).tolist(), -1)
    return np.clip(image + 6.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Selection:
    """Which composites are made.

    Attributes:
        repeats: for each photograph, distance and damage.
        sample: number of composites, spread over all of these; None for all.
        shown: the part of the photograph around the board, or the whole.
        ids: number of possible ids; None for all of the family.
    """

    repeats: int = 1
    sample: int | None = None
    shown: Literal["part", "whole"] = "part"
    ids: int | None = None


def composites(photos: Sequence[np.ndarray], selection: Selection) -> Iterator[Composite]:
    """Yield a board for each photograph, distance, damage and repeat, or for some of them."""
    every = list(product(range(len(photos)), DISTANCES, range(len(DAMAGE)), range(selection.repeats)))
    if selection.sample is not None:
        every = spread(every, selection.sample)
    for number, distance, kind, repeat in every:
        rng = np.random.default_rng([number, int(distance), kind, repeat])
        yield composite(photos[number], distance, DAMAGE[kind], rng, selection.shown, selection.ids)


def spread(every: list[tuple[int, float, int, int]], count: int) -> list[tuple[int, float, int, int]]:
    """Return `count` of the composites, each damage about equally often."""
    mixed = [every[k] for k in np.random.default_rng(0).permutation(len(every))]
    turns = {kind: [each for each in mixed if each[2] == kind] for kind in range(len(DAMAGE))}
    return [each for turn in zip(*turns.values(), strict=True) for each in turn][:count]


def composite(
    photo: np.ndarray,
    distance: float,
    damage: str,
    rng: np.random.Generator,
    shown: Literal["part", "whole"] = "part",
    ids: int | None = None,
) -> Composite:
    """Return a photograph, or the part of it around the board, with a damaged board; see `Selection`."""
    height, width = photo.shape[:2]
    focal = _FOCAL * width
    camera = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    marker_id, turn = int(rng.integers(100)), np.deg2rad(rng.uniform(-40.0, 40.0))
    aside = rng.uniform(-0.3, 0.3) * distance
    pose = marker_pose(np.array([[distance, aside, rng.uniform(0.5, 2.0)]]), np.array([np.pi + turn]))[0]
    outline = marker_outline(pose, 1.0, camera, CAMERA)
    board, alpha = _board(marker_id, damage, rng)
    size = _AROUND / cells_across(FAMILY) + 0.5 * board_size(FAMILY, 1.0)
    corners = marker_outline(pose, 2.0 * size, camera, CAMERA)
    image = _paint(photo, board, alpha, corners, damage, rng)
    known = None if ids is None else known_ids(marker_id, ids, rng)
    if shown == "whole":
        return Composite(image, marker_id, outline, known, camera, distance, damage)
    around = _PART + (outline.max(0) - outline.min(0)).max()
    low = np.maximum(np.floor(outline.min(0) - around), 0).astype(int)
    high = np.minimum(np.ceil(outline.max(0) + around), (width, height)).astype(int)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    camera[:2, 2] -= low
    return Composite(part, marker_id, outline - low, known, camera, distance, damage)


def known_ids(marker_id: int, count: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Return an id and `count` - 1 others."""
    others = rng.permutation([each for each in range(marker_count(FAMILY)) if each != marker_id])[: count - 1]
    return tuple(sorted([marker_id, *others.tolist()]))


def _board(marker_id: int, damage: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return brightness (0 to 1) and opacity of a board with `_AROUND` cells around it."""
    cells = board_cells(FAMILY, marker_id)
    board = np.pad(np.kron(np.where(cells, 0.9, 0.1), np.ones((_FINE, _FINE))), _AROUND * _FINE)
    alpha = np.pad(np.ones((len(cells) * _FINE,) * 2), _AROUND * _FINE)
    side, whole, start = len(cells) * _FINE, len(board), _AROUND * _FINE
    y, x = np.mgrid[:whole, :whole].astype(float)

    def cover(where: np.ndarray, tone: float) -> None:
        board[where], alpha[where] = tone, 1.0

    angle = rng.uniform(-0.35, 0.35)
    if damage.startswith("bar"):
        fraction = float(damage.split()[1]) / 100.0
        middle = start + rng.uniform(0.15, 0.85) * side
        across = (x - middle) * np.cos(angle) + (y - 0.5 * whole) * np.sin(angle)
        cover(np.abs(across) < 0.5 * fraction * side, rng.uniform(0.15, 0.7))
    elif damage == "corner":
        radius = rng.uniform(0.3, 0.42) * side
        corner = start + side * rng.integers(0, 2, 2)
        ragged = 1.0 + 0.2 * np.sin(7.0 * np.arctan2(y - corner[1], x - corner[0]) + rng.uniform(0.0, 6.0))
        cover(np.hypot(x - corner[0], y - corner[1]) < radius * ragged, rng.uniform(0.15, 0.4))
    elif damage == "side 25 %":
        edge = start + 0.25 * side * (1.0 + 0.15 * np.sin(0.06 * y + rng.uniform(0.0, 6.0)))
        covered = x < edge
        for _ in range(rng.integers(4)):
            covered = np.rot90(covered)
        cover(covered, rng.uniform(0.15, 0.4))
    elif damage == "dirt":
        noise = cv2.GaussianBlur(rng.standard_normal(board.shape), (0, 0), 0.06 * side)
        amount = np.clip(2.5 * (noise / noise.std() - 0.4), 0.0, 0.85)
        board[:] = np.where(alpha > 0.0, (1.0 - amount) * board + amount * 0.35, board)
    elif damage == "shadow 65 %":
        turn, offset = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.25, 0.25) * side
        away = (x - 0.5 * whole) * np.cos(turn) + (y - 0.5 * whole) * np.sin(turn)
        board *= np.where(away > offset, 0.35, 1.0)
    elif damage == "leaf shadows":
        noise = cv2.GaussianBlur(rng.standard_normal(board.shape), (0, 0), 0.05 * side)
        board *= np.where(noise > 0.3 * noise.std(), 0.4, 1.0)
    return board, alpha


def _paint(
    photo: np.ndarray, board: np.ndarray, alpha: np.ndarray, corners: np.ndarray, damage: str, rng: np.random.Generator
) -> np.ndarray:
    """Return the photograph with the board in front of it, blurred by the lens and with the camera's noise."""
    image, more = photo.astype(np.float32), 4
    low = np.maximum(np.floor(corners.min(0)).astype(int) - 12, 0)
    high = np.minimum(np.ceil(corners.max(0)).astype(int) + 12, photo.shape[1::-1])
    width, height = (high - low).tolist()
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32) * len(board) - 0.5
    target = (more * (corners - low) - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(square, target)
    warped = [
        cv2.resize(
            cv2.warpPerspective(each.astype(np.float32), matrix, (more * width, more * height), flags=cv2.INTER_AREA),
            (width, height),
            interpolation=cv2.INTER_AREA,
        )
        for each in (board * alpha, alpha)
    ]
    sigma = 0.6 if damage != "blur" else rng.uniform(1.2, 1.8)
    shown, opacity = (cv2.GaussianBlur(each, (0, 0), sigma) for each in warped)
    part = image[low[1] : high[1], low[0] : high[0]]
    light = rng.uniform(110.0, 240.0)
    noise = 2.0 * rng.standard_normal(part.shape)
    part[:] = part * (1.0 - opacity[..., None]) + light * shown[..., None] + noise * (opacity[..., None] > 0.0)
    return np.clip(image, 0, 255).astype(np.uint8)
