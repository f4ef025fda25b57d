"""SD maps from GeoJSON files, such as OpenStreetMap's exports: LineStrings in WGS84 around a place.

A line's category is its property `category`, one of the names of `CATEGORIES`, or follows from its OpenStreetMap tag
`highway` (`HIGHWAYS`; values that are not listed there are "other", and of several the first that is listed counts). A
property that is null is none: exports of a table fill in what a feature does not have. Points and polygons are
ignored, and lines that have neither property are left out: exports also contain rivers, buildings and power lines.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.files.fields import load_json
from tflane_jax.files.wording import shown
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.world.roads.sd_map import SdMapConfig, pack_lines

# Names of SMERF's categories (https://github.com/NVlabs/SMERF).
CATEGORIES = {
    "road": SdCategory.ROAD,
    "cross_walk": SdCategory.CROSSWALK,
    "side_walk": SdCategory.CROSSWALK,
    "pedestrian": SdCategory.CROSSWALK,
    "truck_road": SdCategory.TRUCK_ROAD,
    "highway": SdCategory.HIGHWAY,
    "residential": SdCategory.RESIDENTIAL,
    "service": SdCategory.SERVICE,
    "bus_way": SdCategory.BUS_WAY,
    "other": SdCategory.OTHER,
}
# SMERF's categories of OpenStreetMap's values of `highway`, and `crossing`, which SMERF counts as other. A link counts
# as what it links.
HIGHWAYS = {
    "motorway": SdCategory.TRUCK_ROAD,
    "trunk": SdCategory.TRUCK_ROAD,
    "primary": SdCategory.HIGHWAY,
    "secondary": SdCategory.HIGHWAY,
    "tertiary": SdCategory.HIGHWAY,
    "road": SdCategory.ROAD,
    "residential": SdCategory.RESIDENTIAL,
    "living_street": SdCategory.RESIDENTIAL,
    "service": SdCategory.SERVICE,
    "busway": SdCategory.BUS_WAY,
    "bus_guideway": SdCategory.BUS_WAY,
    "crossing": SdCategory.CROSSWALK,
    "footway": SdCategory.CROSSWALK,
    "pedestrian": SdCategory.CROSSWALK,
    "path": SdCategory.CROSSWALK,
    "steps": SdCategory.CROSSWALK,
}
_LINES = {"LineString": 1, "MultiLineString": 2}
_OTHERS = ("Point", "MultiPoint", "Polygon", "MultiPolygon", "GeometryCollection")
# Distance, metres, beyond which the nearest road is no road of the vehicle's surroundings.
_ELSEWHERE = 1e5
# WGS84: semi-major axis, metres, and squared eccentricity.
_AXIS, _ECCENTRICITY = 6_378_137.0, 6.694379990141e-3


@dataclass(frozen=True)
class Origin:
    """Pose of the vehicle.

    Attributes:
        latitude, longitude: WGS84, degrees.
        heading: degrees clockwise from north, as GNSS receivers report it.

    Raises UserError for a place that is not on Earth, and for a heading that is no number.
    """

    latitude: float
    longitude: float
    heading: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude) <= 90.0 and abs(self.longitude) <= 180.0 and math.isfinite(self.heading)):
            raise UserError(
                f"{self} is no pose on Earth: give latitude (-90 to 90), longitude (-180 to 180) and heading in degrees"
            )


@dataclass(frozen=True)
class RoadLines:
    """The lines of a file.

    Attributes:
        lines: (n, 2) longitude and latitude, degrees, float64.
        category: of each, `SdCategory`.
    """

    lines: tuple[np.ndarray, ...]
    category: tuple[int, ...]


def read_geojson(path: str | Path) -> RoadLines:
    """Read the lines of a FeatureCollection. Warns (`LeftOutWarning`) of lines without a category, which are left out.

    Raises:
        UserError: the file is no GeoJSON in WGS84, no line has a category, one has an unknown category, or coordinates
            are not on Earth. The message names the file, the feature (by its number, from 0, and its id) and the
            remedy.
    """
    lines, category, others = [], [], []
    for name, feature in read_features(Path(path)):
        geometry = feature.get("geometry")
        if geometry is None:
            continue
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        if not isinstance(kind, str) or kind not in _LINES:
            if kind not in _OTHERS:
                raise UserError(f"{name} has a geometry of type {shown(kind)}: export roads as LineString")
            if kind == "GeometryCollection" and _category(feature.get("properties"), name) is not None:
                raise UserError(f"{name} is a road as GeometryCollection: export roads as LineString")
            continue
        label = _category(feature.get("properties"), name)
        if label is None:
            others.append(name)
            continue
        found = line_coordinates(geometry.get("coordinates"), _LINES[kind], name)
        lines += found
        category += [label] * len(found)
    neither = "neither of the properties `highway` and `category`"
    if others and not lines:
        raise UserError(f"{others[0]} has {neither}, and no other line has: add one of them to the roads")
    if others:
        known = len(others) + len(lines)
        message = f"{len(others)} of {known} lines have {neither} and are left out, the first: {others[0]}"
        warnings.warn(message, LeftOutWarning, stacklevel=2)
    return RoadLines(tuple(lines), tuple(category))


def sd_map_around(roads: RoadLines, origin: Origin, config: SdMapConfig) -> SdMap:
    """Return the part of a map around the vehicle, in its ego frame.

    Only `lines`, `points` and `range` of the config are used: a real map has real faults, so none are simulated. Warns
    (`TruncationWarning`) if more lines are in range than the capacity.

    Raises UserError if every road is more than 100 km away: then longitude and latitude are swapped, or it is the map
    of another place.
    """
    lines = [to_ego(line, origin) for line in roads.lines]
    nearest = min((float(np.linalg.norm(line, axis=-1).min()) for line in lines), default=0.0)
    if nearest > _ELSEWHERE:
        raise UserError(
            f"the nearest road is about {nearest / 1000:,.0f} km from the origin (latitude {origin.latitude:g}, "
            f"longitude {origin.longitude:g}): are longitude and latitude swapped?"
        )
    sd_map, dropped = pack_lines(
        lines, roads.category, capacity=config.lines, points=config.points, range_=config.range
    )
    if dropped:
        warnings.warn(
            f"more lines in range than SdMapConfig.lines = {config.lines}: the farthest are left out",
            TruncationWarning,
            stacklevel=2,
        )
    return sd_map


def to_ego(line: Float[np.ndarray, "n 2"], origin: Origin) -> Float[np.ndarray, "n 2"]:
    """Return longitudes and latitudes (degrees) as metres in the ego frame.

    Equirectangular projection with the ellipsoid's two radii of curvature at the origin. Its error grows with the
    square of the distance d, to about tan(latitude) d^2 / 6,400 km: at 60 degrees 3 mm at 100 m, 0.3 m at 1 km.
    """
    latitude = math.radians(origin.latitude)
    shrink = 1.0 - _ECCENTRICITY * math.sin(latitude) ** 2
    across = _AXIS / math.sqrt(shrink)
    along = across * (1.0 - _ECCENTRICITY) / shrink
    # The shorter way round, for lines at the 180th meridian.
    turn = (line[:, 0] - origin.longitude + 180.0) % 360.0 - 180.0
    east = across * math.cos(latitude) * np.radians(turn)
    north = along * np.radians(line[:, 1] - origin.latitude)
    heading = math.radians(origin.heading)
    sin, cos = math.sin(heading), math.cos(heading)
    return np.stack([sin * east + cos * north, sin * north - cos * east], -1)


def read_features(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the features of a file, each with its name for error messages."""
    content = load_json(path)
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or content.get("type") != "FeatureCollection":
        raise UserError(f"{path} is no GeoJSON FeatureCollection: export it again as GeoJSON")
    system = str(content.get("crs") or "CRS84")
    if not any(name in system for name in ("CRS84", "4326")):
        raise UserError(f"{path} is not in WGS84 but has the crs {system}: convert it to EPSG:4326")
    for number, feature in enumerate(features):
        name = f"{path}: feature {number}"
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise UserError(f"{name} is no GeoJSON Feature: take it out or export the file again")
        yield (f"{name} ({feature['id']})" if "id" in feature else name), feature


def line_coordinates(coordinates: Any, depth: int, name: str) -> list[np.ndarray]:
    """Return the lines of a geometry; `depth` is 1 for one line and 2 for several."""
    lines = []
    several: list[Any] = coordinates if depth == 2 and isinstance(coordinates, list) else [coordinates]
    for line in several:
        try:
            # A third number is the height.
            points = np.array([point[:2] for point in line], np.float64)
        except (TypeError, ValueError, IndexError, KeyError, OverflowError):
            points = np.zeros(0)
        if points.ndim != 2 or points.shape[-1] != 2 or len(points) < 2:
            raise UserError(f"{name} is no line of at least two points [longitude, latitude]: mend it or take it out")
        if not ((np.abs(points[:, 0]) <= 180.0) & (np.abs(points[:, 1]) <= 90.0)).all():
            raise UserError(
                f"{name} leaves the Earth: coordinates must be [longitude, latitude] in degrees, longitude first"
            )
        lines.append(points)
    return lines


def _category(properties: Any, name: str) -> int | None:
    """Return the category of a line, None where neither property says it."""
    properties = properties if isinstance(properties, dict) else {}
    named, tag = properties.get("category"), properties.get("highway")
    if named is not None:
        if not isinstance(named, str) or named not in CATEGORIES:
            raise UserError(f"{name} has the category {shown(named)}: choose one of {', '.join(CATEGORIES)}")
        return CATEGORIES[named]
    if tag is None:
        return None
    # Roads that a tool has joined have several values, as a list or with semicolons between them.
    values = tag if isinstance(tag, list) else str(tag).split(";")
    known = [HIGHWAYS.get(str(value).strip().removesuffix("_link")) for value in values]
    return next((category for category in known if category is not None), SdCategory.OTHER)
