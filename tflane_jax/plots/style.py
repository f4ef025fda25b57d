"""Colours of the pictures; each has one meaning throughout the project. Scenes have a dark background, curves a white
one.
"""

from __future__ import annotations

from typing import Any

from tflane_jax.scene import BevChannel, LineClass, RoadUser

# Curves of several models, on white. Okabe and Ito's colours (Color Universal Design, 2008) without their yellow:
# people who see no difference between red and green tell them apart.
SERIES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000")
_DASHES = ("-", "--", ":")

ROAD = "#1b1f27"
GRID = "#39404d"
HATCH = "#5a6373"
EGO = "#ffffff"
PREDICTION = "#4dd2ff"
LINK = "#ff5fd2"
# Outline of a lane to which a picture points.
OUTLINE = "#ffee58"

# Colours of a true lane that is fully in line of sight and fully hidden; others lie between.
LANE_CLEAR = "#8be28b"
LANE_HIDDEN = "#ff9d3c"

# Boundaries of true lane segments.
BOUNDARY = "#e6e2d3"
ROAD_BOUNDARY = "#7f8da3"
CROSSING = "#b9a5e2"

# Lines of a vector map.
MAP_LINE = {
    LineClass.DIVIDER: "#ffc46b",
    LineClass.CROSSING: CROSSING,
    LineClass.BOUNDARY: "#7f8fff",
    LineClass.CENTERLINE: LANE_CLEAR,
}

# Colour of each evidence channel at full strength (red, green, blue, 0 to 1).
EVIDENCE = {
    BevChannel.LANE_PAINT: (1.00, 0.93, 0.68),
    BevChannel.ROAD_EDGE: (0.28, 0.50, 0.78),
    BevChannel.CROSSING: (0.52, 0.42, 0.70),
    BevChannel.OBSTACLE: (0.60, 0.20, 0.24),
}

ROAD_USER = {
    RoadUser.CAR: "#6ea8fe",
    RoadUser.TRUCK: "#f2b84b",
    RoadUser.BUS: "#ff7a6b",
    RoadUser.MOTORCYCLE: "#c792ea",
    RoadUser.BICYCLE: "#4fd1c5",
    RoadUser.PEDESTRIAN: "#f6e58d",
}

# Boards of markers that are used, with the lanes of their store (in drives, by confidence), and roads of an SD map.
BOARD, BOARD_LANE = "#34c759", (1.00, 0.93, 0.35)
SD_ROAD = "#c98bb0"

# OpenLane-V2 attributes of a traffic light; any other state or element is drawn in grey.
LIGHT = {1: "#ff3b30", 2: "#34c759", 3: "#ffcc00"}
OTHER_ELEMENT = "#c8ccd4"


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour "#rrggbb", for drawing into images."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def curve_style(number: int) -> dict[str, Any]:
    """Return colour and line style of a curve by its number; the colours come again with other lines."""
    return {
        "color": SERIES[number % len(SERIES)],
        "linestyle": _DASHES[number // len(SERIES) % len(_DASHES)],
    }
