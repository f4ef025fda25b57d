"""Pictures of the masks of the traffic-flow module."""

import numpy as np
import pytest

from tflane_jax.plots.attention import (
    draw_spatial_mask,
    draw_temporal_mask,
)
from tflane_jax.plots.figure import new_figure, save_figure

pytest.importorskip("matplotlib")


def test_masks_are_drawn(tmp_path):
    figure, axes = new_figure(1, 2)
    draw_temporal_mask(axes[0, 0], np.eye(3, 5, dtype=bool))
    draw_spatial_mask(axes[0, 1], np.ones((7, 7), bool), lanes=4)
    assert sorted(text.get_text() for text in axes[0, 1].texts) == ["L→L", "L→T", "T→L", "T→T"]
    assert save_figure(figure, tmp_path / "masks.png").stat().st_size > 2000
