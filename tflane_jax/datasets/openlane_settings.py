"""Settings of OpenLane-V2: which frames, and how they become examples (`openlane_v2`)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Literal

from tflane_jax.datasets.base import ExampleConfig, Split
from tflane_jax.datasets.openlane_can_bus import CanBus
from tflane_jax.datasets.openlane_frames import SubsetName
from tflane_jax.datasets.openlane_markers import BoardsConfig
from tflane_jax.datasets.openlane_tracks import WithoutTracks
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, ImageConfig

Flavour = Literal["centerline", "lane_segment", "both"]
OPENLANE_V2_SIZES = ExampleConfig(lanes=128, segments=192, areas=64, elements=48)
"""Capacities of an example; a frame of subset A has about 60 centerlines, 75 lane segments and 11 elements."""


@dataclass(frozen=True)
class OpenLaneV2Settings:
    """How frames become examples: the settings of one split and of a run have these in common.

    Attributes:
        root: folder of the dataset.
        subset: A is from Argoverse 2 (7 cameras), B from nuScenes (6 cameras).
        flavour: which files are read: "centerline" (`Example.lanes`), "lane_segment" (`Example.segments` and areas), or
            "both". Traffic elements come from the centerline files if these are read, and then tell which centerlines
            they govern (`TrafficElements.lane`), with "lane_segment" which segments.
        data_dict: split file under `root`, see `openlane_frames.list_frames`.
        image: scaling and cropping of the images; None does not read them (`Example.cameras` is None, boxes are in
            pixels of the files).
        example: capacities and points; what does not fit is left out, farthest first, with a `TruncationWarning`.
        loading: memory or disk, and workers; no example depends on it.
        map_changes: "drop" leaves out the logs whose streets differ from their map, see `openlane_frames.MAP_CHANGES`.
        tracks: folder of the Argoverse 2 logs from which subset A was made, or of nuScenes for B; their boxes become
            the traffic flow, as many frames and at the rate that `example.history` and `example.history_hz` say. None:
            no traffic flow.
        without_tracks: what becomes of frames whose log is not there, see `openlane_tracks.WithoutTracks`.
        boards: virtual markers, where `example.markers` asks for the prior; the official test split, which has no
            lanes, gets none. `example.sd_map` asks for the official SD map.
        can_bus: "reference": images come with the numbers of the pose that published weights read
            (`openlane_can_bus`, `BevFormerConfig.motion`).
    """

    root: Path
    _: KW_ONLY
    subset: SubsetName = "A"
    flavour: Flavour = "centerline"
    data_dict: str | None = None
    image: ImageConfig | None = TOPONET_SUBSET_A
    example: ExampleConfig = OPENLANE_V2_SIZES
    loading: StreamingConfig = StreamingConfig()
    map_changes: Literal["keep", "drop"] = "keep"
    tracks: Path | None = None
    without_tracks: WithoutTracks = "refuse"
    boards: BoardsConfig = BoardsConfig()
    can_bus: CanBus = "none"


@dataclass(frozen=True)
class OpenLaneV2Config(OpenLaneV2Settings):
    """One split.

    Attributes:
        split: the official test split has no annotations, so its examples have no valid lane.
    """

    split: Split = "train"
