"""Pictures of attention: lines from lanes to road users, matrices, masks."""

import numpy as np
import pytest

from tests.fakes import fake_example
from tflane_jax.plots.attention import (
    draw_attention_matrix,
    draw_lane_attention,
    draw_spatial_mask,
    draw_temporal_mask,
)
from tflane_jax.plots.figure import new_figure, save_figure

pytest.importorskip("matplotlib")


def test_lines_join_lanes_and_attended_road_users(ax):
    example = fake_example(padding=np.nan)
    weights = np.asarray([[0.0, 0.6, 0.9], [0.3, 0.01, np.nan]])
    # Token 0 is road user 1 and token 1 is road user 0; token 2 is padding.
    draw_lane_attention(
        ax,
        example.lanes.points[:2],
        example.traffic_flow,
        weights,
        instance=np.asarray([1, 0, 0]),
        valid=np.asarray([True, True, False]),
    )
    middle, last = example.lanes.points[:, 2, :2], example.traffic_flow.position[:, -1, :2]
    np.testing.assert_allclose(
        ax.collections[0].get_segments(), [[middle[0], last[0]], [middle[1], last[1]]], rtol=1e-6
    )
    np.testing.assert_allclose(ax.collections[0].get_colors()[:, 3], [0.6, 0.3])


def test_lanes_that_are_not_valid_are_left_out(ax):
    example = fake_example()
    draw_lane_attention(
        ax,
        example.lanes.points[:2],
        example.traffic_flow,
        np.ones((2, 2)),
        instance=np.arange(2),
        valid=np.ones(2, bool),
        lane_valid=np.asarray([True, False]),
    )
    assert len(ax.collections[0].get_segments()) == 2


def test_no_tokens_and_no_lanes_are_drawn(ax):
    flow = fake_example().traffic_flow
    draw_lane_attention(
        ax, np.zeros((0, 4, 3)), flow, np.zeros((0, 3)), instance=np.zeros(3, int), valid=np.zeros(3, bool)
    )
    assert ax.collections[0].get_segments() == []


def test_padding_is_blank_in_the_matrix(ax):
    draw_attention_matrix(ax, np.asarray([[0.2, np.nan], [0.8, 5.0]]), valid=np.asarray([True, False]))
    shown = ax.images[0].get_array()
    np.testing.assert_array_equal(shown.mask, [[False, True], [False, True]])
    assert ax.images[0].get_clim() == (0.0, 0.8)


def test_masks_are_drawn(tmp_path):
    figure, axes = new_figure(1, 2)
    draw_temporal_mask(axes[0, 0], np.eye(3, 5, dtype=bool))
    draw_spatial_mask(axes[0, 1], np.ones((7, 7), bool), lanes=4)
    assert sorted(text.get_text() for text in axes[0, 1].texts) == ["L→L", "L→T", "T→L", "T→T"]
    assert save_figure(figure, tmp_path / "masks.png").stat().st_size > 2000
