"""The figure of marker detection over distance."""

import numpy as np
import pytest

from tflane_jax.markers.curves import Sighting, summarise
from tflane_jax.plots.marker_curves import save_error_curves


def test_the_picture_is_written_and_names_the_assumption(tmp_path, monkeypatch):
    figure = pytest.importorskip("matplotlib.figure").Figure
    drawn, savefig = [], figure.savefig
    monkeypatch.setattr(figure, "savefig", lambda self, *a, **k: (drawn.append(self), savefig(self, *a, **k)))
    rows = summarise([Sighting(0, 0.0, 10.0, True, 50.0, np.ones(3), 1.0, 30.0, 0.1, 0.2)])
    path = save_error_curves(
        tmp_path / "curves.png", {"one": rows, "none": []} | {f"subpixel, scale {i}": rows for i in range(3)}, 40.0
    )
    assert path.stat().st_size > 1000
    (legend,) = drawn[0].legends
    names = [text.get_text() for text in legend.get_texts()]
    assert (names[:2], names[-1]) == (["one", "none"], "the paper's assumption (found: sigma_d = 40 m)")
    assert legend.get_window_extent().width < drawn[0].bbox.width
