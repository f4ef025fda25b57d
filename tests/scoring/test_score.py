"""Bootstrap intervals over scenes."""

import numpy as np
import pytest

from tflane_jax.metrics import MapDetections, MapTruth, VectorMapMetrics
from tflane_jax.scoring.score import Scored


class Errors:
    """An accumulator whose error exists only where something was matched."""

    def __init__(self, values=()):
        self.values = list(values)

    def merge(self, *others):
        return Errors(sum((other.values for other in others), self.values))

    def compute(self):
        return {"frames": 3.0} | ({"error": sum(self.values) / len(self.values)} if self.values else {})


def test_a_number_that_a_sample_lacks_has_no_interval():
    """The remaining samples would be those that drew a scene with a match."""
    some, every = Scored({"a": Errors([1.0]), "b": Errors()}), Scored({"a": Errors([1.0]), "b": Errors([3.0])})
    assert some.intervals(50, progress=False) == {"frames": (3.0, 3.0)}
    found = every.intervals(50, progress=False)
    assert found["error"] == (1.0, 3.0)


def test_an_interval_holds_95_percent_of_the_draws():
    """The mean over 50 scenes is nearly normal: 1.96 standard errors to either side."""
    values = np.random.default_rng(0).uniform(size=50)
    scenes = {str(number): Errors([value]) for number, value in enumerate(values.tolist())}
    low, high = Scored(scenes).intervals(2000, progress=False)["error"]
    assert high - low == pytest.approx(2.0 * 1.96 * values.std() / np.sqrt(50), rel=0.08)


def test_a_class_that_a_draw_lacks_is_no_error():
    """Regression: two of ten drives have crossings, all lines are found, and the interval of mAP began at 2/3."""
    line = np.array([[0.0, 0.0], [9.0, 0.0]])
    scenes = {}
    for number in range(10):
        classes = np.array([0, 2, 1] if number < 2 else [0, 2])
        lines = [np.add(line, (0.0, 9.0 * kind)) for kind in classes]
        scenes[str(number)] = metrics = VectorMapMetrics()
        metrics.update(MapDetections(lines, classes, np.full(len(lines), 0.9)), MapTruth(lines, classes))
    found = Scored(scenes).intervals(50, progress=False)
    assert found["mAP"] == found["AP_divider"] == (1.0, 1.0)
    assert "AP_ped_crossing" not in found
    # A class that the whole file lacks counts 0 in it, as officially, and so in every draw.
    without = {name: metrics for name, metrics in scenes.items() if int(name) > 1}
    assert Scored(without).total()["mAP"] == pytest.approx(2 / 3)
    assert Scored(without).intervals(20, progress=False)["mAP"] == pytest.approx((2 / 3, 2 / 3))
