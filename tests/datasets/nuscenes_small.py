"""nuScenes in small, written by hand: two scenes of v1.0-mini with every trap of the schema, and their maps.

scene-0061, four samples: the vehicle drives north (yaw 90 degrees), 5 m between samples, from (400, 1100). A car drives
10 m ahead and 3 m to the left at the same speed and has no box in sample 2. scene-0103, two samples, the vehicle stands
at (50, 60), heading east, pitched by 2 degrees. The map of scene-0061 has one lane under the vehicle, 40 m long and
3.5 m wide, and a connector that turns left after it.
"""

import json

import numpy as np

START = 1_532_402_927_000_000
NORTH = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
EAST = [1.0, 0.0, 0.0, 0.0]
PITCH = np.deg2rad(2.0)
PITCHED = [np.cos(PITCH / 2), 0.0, np.sin(PITCH / 2), 0.0]
# Camera axes: x right, y down, z forward.
FORWARD = [0.5, -0.5, 0.5, -0.5]
RIGHTWARD = [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]
# 20 m ahead, 1 m to the left and 0.5 m above the ground in the frame of the pitched vehicle.
AHEAD_OF_PITCHED = (
    50 + 20 * np.cos(PITCH) + 0.5 * np.sin(PITCH),
    61.0,
    0.5 * np.cos(PITCH) - 20 * np.sin(PITCH),
)
K = [[1000.0, 0.0, 800.0], [0.0, 1000.0, 450.0], [0.0, 0.0, 1.0]]
# The camera is exposed 40 ms after the lidar's sweep; meanwhile the vehicle drives 0.4 m.
LATE, DRIVEN = 40_000, 0.4


def box(token, sample, instance, position, rotation, *, size=(2.0, 4.5, 1.6), points=(5, 1), visibility="4"):
    return {
        "token": token,
        "sample_token": sample,
        "instance_token": instance,
        "attribute_tokens": [],
        "visibility_token": visibility,
        "translation": list(position),
        "size": list(size),  # width, length, height
        "rotation": list(rotation),
        "num_lidar_pts": points[0],
        "num_radar_pts": points[1],
        "prev": "",
        "next": "",
    }


def tables():
    """Return the thirteen tables by name; neither sample.data nor sample.anns is in the files."""
    samples, data, poses = [], [], []
    for scene, count, heading in (("a", 4, NORTH), ("b", 2, PITCHED)):
        for i in range(count):
            name = f"{scene}{i}"
            samples.append(
                {
                    "token": f"sample-{name}",
                    "timestamp": START + 500_000 * i,
                    "scene_token": f"scene-{scene}",
                    "prev": f"sample-{scene}{i - 1}" if i else "",
                    "next": f"sample-{scene}{i + 1}" if i + 1 < count else "",
                }
            )
            for channel, late, key in (("LIDAR_TOP", 0, True), ("CAM_FRONT", LATE, True), ("LIDAR_TOP", 50_000, False)):
                token = f"{name}-{channel}-{late}"
                y = 1100.0 + 5 * i + (DRIVEN if late == LATE else 0.0)
                place = [400.0, y, 0.0] if scene == "a" else [50.0, 60.0, 0.0]
                time = START + 500_000 * i + late
                poses.append({"token": f"pose-{token}", "timestamp": time, "translation": place, "rotation": heading})
                data.append(
                    {
                        "token": f"data-{token}",
                        "sample_token": f"sample-{name}",
                        "ego_pose_token": f"pose-{token}",
                        "calibrated_sensor_token": f"calibrated-{channel}",
                        "filename": f"samples/{channel}/{name}.jpg",
                        "fileformat": "jpg",
                        "width": 64 if channel == "CAM_FRONT" else 0,
                        "height": 36 if channel == "CAM_FRONT" else 0,
                        "timestamp": time,
                        "is_key_frame": key,
                        "prev": "",
                        "next": "",
                    }
                )
    boxes = [box(f"car-{i}", f"sample-a{i}", "car", (397.0, 1110.0 + 5 * i, 1.0), NORTH) for i in (3, 0, 1)]
    boxes += [
        # Without points and without a level of visibility.
        box("walker", "sample-a1", "walker", (402.0, 1105.0, 1.0), EAST, size=(0.6, 0.7, 1.8), points=(0, 0))
        | {"visibility_token": ""},
        box("bus", "sample-a2", "bus", (400.0, 1130.0, 1.5), NORTH, size=(3.0, 12.0, 3.5), visibility="1"),
        box("cone", "sample-a2", "cone", (401.0, 1120.0, 0.3), EAST, size=(0.3, 0.3, 0.7)),
        box("van", "sample-b1", "van", AHEAD_OF_PITCHED, PITCHED),
    ]
    kinds = {"car": "vehicle.car", "van": "vehicle.car", "walker": "human.pedestrian.adult"}
    kinds |= {"bus": "vehicle.bus.bendy", "cone": "movable_object.trafficcone"}
    calibrated = {
        "LIDAR_TOP": ([0.94, 0.0, 1.84], RIGHTWARD, []),
        "CAM_FRONT": ([1.5, 0.0, 1.5], FORWARD, K),
    }
    return {
        "attribute": [{"token": "moving", "name": "vehicle.moving", "description": ""}],
        "category": [{"token": f"is-{kind}", "name": kind, "index": 0} for kind in sorted({*kinds.values()})],
        "visibility": [
            {"token": str(n), "level": level} for n, level in enumerate(("v0-40", "v40-60", "v60-80", "v80-100"), 1)
        ],
        "log": [{"token": "log-a", "location": "singapore-onenorth"}, {"token": "log-b", "location": "boston-seaport"}],
        # The mini data set's table of maps names logs of the full one.
        "map": [{"token": "map", "log_tokens": ["log-a", "log-of-the-full-set"], "filename": "maps/x.png"}],
        "sensor": [{"token": f"sensor-{name}", "channel": name, "modality": name[:3].lower()} for name in calibrated],
        "calibrated_sensor": [
            {
                "token": f"calibrated-{name}",
                "sensor_token": f"sensor-{name}",
                "translation": place,
                "rotation": rotation,
                "camera_intrinsic": intrinsic,
            }
            for name, (place, rotation, intrinsic) in calibrated.items()
        ],
        "scene": [
            {
                "token": f"scene-{one}",
                "name": name,
                "log_token": f"log-{one}",
                "nbr_samples": count,
                "first_sample_token": f"sample-{one}0",
                "last_sample_token": f"sample-{one}{count - 1}",
                "description": "",
            }
            for one, name, count in (("b", "scene-0103", 2), ("a", "scene-0061", 4))
        ],
        "sample": samples,
        "sample_data": data,
        "ego_pose": poses,
        "instance": [{"token": name, "category_token": f"is-{kind}"} for name, kind in kinds.items()],
        "sample_annotation": boxes,
    }


class _MapWriter:
    """Collects nodes, lines and polygons."""

    def __init__(self):
        self.content = {"version": "1.3", "canvas_edge": [3000.0, 3000.0], "node": [], "line": [], "polygon": []}
        self.content |= {"arcline_path_3": {}, "connectivity": {}}
        layers = ("lane", "lane_connector", "road_segment", "road_divider", "lane_divider", "ped_crossing")
        self.content |= {layer: [] for layer in layers}

    def nodes(self, points):
        first = len(self.content["node"])
        self.content["node"] += [{"token": f"n{first + i}", "x": x, "y": y} for i, (x, y) in enumerate(points)]
        return [f"n{first + i}" for i in range(len(points))]

    def line(self, *points):
        token = f"line-{len(self.content['line'])}"
        self.content["line"].append({"token": token, "node_tokens": self.nodes(points)})
        return token

    def polygon(self, *points, holes=()):
        token = f"polygon-{len(self.content['polygon'])}"
        holes = [{"node_tokens": self.nodes(hole)} for hole in holes]
        self.content["polygon"].append({"token": token, "exterior_node_tokens": self.nodes(points), "holes": holes})
        return token


def straight(start, length):
    """Return an arcline path that goes straight (its arcs have no length)."""
    return {"start_pose": start, "shape": "LSR", "radius": 999.9, "segment_length": [0.0, length, 0.0]}


def city():
    """Return the map of scene-0061."""
    write = _MapWriter()
    content = write.content
    sides = [
        {"node_token": "n0", "segment_type": kind} for kind in ("NIL", "DOUBLE_DASHED_WHITE", "SINGLE_DASHED_WHITE")
    ]
    content["lane"] = [
        {
            "token": "north",
            "polygon_token": write.polygon((398.25, 1090), (401.75, 1090), (401.75, 1130), (398.25, 1130)),
            "lane_type": "CAR",
            "left_lane_divider_segments": sides,
            "right_lane_divider_segments": [{"node_token": "n1", "segment_type": "SINGLE_SOLID_YELLOW"}],
        },
        # No arcline: the lane counts as road, but cannot be a lane.
        {
            "token": "without",
            "polygon_token": write.polygon((401.75, 1090), (405.25, 1090), (405.25, 1130), (401.75, 1130)),
            "lane_type": "CAR",
            "left_lane_divider_segments": [],
            "right_lane_divider_segments": [],
        },
    ]
    content["lane_connector"] = [{"token": "turn", "polygon_token": None}]
    content["arcline_path_3"] = {
        "north": [straight([400.0, 1090.0, np.pi / 2], 25.0), straight([400.0, 1115.0, np.pi / 2], 15.0)],
        "turn": [
            {
                "start_pose": [400.0, 1130.0, np.pi / 2],
                "shape": "LSL",
                "radius": 10.0,
                "segment_length": [5 * np.pi, 4.0, 0.0],
            }
        ],
    }
    # "turn" is connected only from its own side; a lane that the file lacks is named.
    content["connectivity"] = {
        "north": {"incoming": ["of-another-file"], "outgoing": ["of-another-file"]},
        "turn": {"incoming": ["north"], "outgoing": []},
        "without": {"incoming": [], "outgoing": []},
    }
    content["road_segment"] = [
        {
            "token": "road",
            "polygon_token": write.polygon(
                (380, 1130), (420, 1130), (420, 1150), (380, 1150), holes=[[(390, 1138), (394, 1138), (392, 1142)]]
            ),
            "is_intersection": True,
        },
        {"token": "null", "polygon_token": None, "is_intersection": False},
    ]
    content["road_divider"] = [{"token": "middle", "line_token": write.line((405.25, 1090), (405.25, 1130))}]
    content["lane_divider"] = [
        {"token": "between", "line_token": write.line((401.75, 1090), (401.75, 1110), (401.75, 1130))},
        {"token": "empty", "line_token": write.line()},
    ]
    content["ped_crossing"] = [
        {"token": "zebra", "polygon_token": write.polygon((398, 1126), (406, 1126), (406, 1129), (398, 1129))},
        {"token": "null", "polygon_token": None},
    ]
    return content


def other_city():
    """Return the map of scene-0103: one lane."""
    content = empty_city()
    content["lane_connector"] = [{"token": "east", "polygon_token": None}]
    content["arcline_path_3"] = {"east": [straight([40.0, 60.0, 0.0], 30.0)]}
    return content


def empty_city():
    """Return a map without any lane."""
    return _MapWriter().content


def write_nuscenes(root, content=None, maps=None):
    """Write the data set into a folder and return it."""
    folder = root / "v1.0-mini"
    (root / "maps" / "expansion").mkdir(parents=True, exist_ok=True)
    folder.mkdir(exist_ok=True)
    for name, rows in (content or tables()).items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    standard = {"singapore-onenorth": city(), "boston-seaport": other_city()}
    for name, one in (standard if maps is None else maps).items():
        (root / "maps" / "expansion" / f"{name}.json").write_text(json.dumps(one))
    return root
