"""The figure of marker detection over distance."""

import numpy as np
import pytest

from tflane_jax.markers.curves import Sighting, summarise
from tflane_jax.plots.marker_curves import save_error_curves


def test_the_picture_is_written(tmp_path):
    pytest.importorskip("matplotlib")
    rows = summarise([Sighting(0, 0.0, 10.0, True, 50.0, np.ones(3), 1.0, 30.0, 0.1, 0.2)])
    path = save_error_curves(tmp_path / "curves.png", {"one": rows, "none": []}, 40.0)
    assert path.stat().st_size > 1000
