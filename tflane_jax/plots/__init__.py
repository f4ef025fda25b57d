"""Pictures and tables. matplotlib (extra `plot`) is imported with the first figure, not with this package."""

from tflane_jax.plots.attention import (
    draw_spatial_mask,
    draw_temporal_mask,
)
from tflane_jax.plots.attribution import draw_bars, draw_lane_bands, draw_removal, draw_road_users
from tflane_jax.plots.bev import draw_lanes, draw_prediction, draw_scene
from tflane_jax.plots.cameras import save_camera_views
from tflane_jax.plots.curves import save_curves
from tflane_jax.plots.differences import Findings, save_differences
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.gallery import add_legend, save_contact_sheet, save_examples
from tflane_jax.plots.summary import dataset_summary
from tflane_jax.plots.tables import format_table, save_table

__all__ = [
    "Findings",
    "add_legend",
    "dataset_summary",
    "draw_bars",
    "draw_lane_bands",
    "draw_lanes",
    "draw_prediction",
    "draw_removal",
    "draw_road_users",
    "draw_scene",
    "draw_spatial_mask",
    "draw_temporal_mask",
    "format_table",
    "new_figure",
    "save_camera_views",
    "save_contact_sheet",
    "save_curves",
    "save_differences",
    "save_examples",
    "save_figure",
    "save_table",
]
