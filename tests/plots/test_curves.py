import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.plots.curves import curves, save_curves

pytest.importorskip("matplotlib")
RECORDS = [
    {"step": 10, "loss": {"total": 9.0, "points": 4.0}, "lr": 1e-4, "note": "warm-up", "eval": None},
    {"step": 20, "loss": {"total": 0.1, "points": float("nan")}, "lr": 2e-4, "eval": {"all/DET_l": [0.1, 0.3]}},
]


def test_values_are_sorted_by_name_step_and_seed():
    series = curves(RECORDS)
    assert list(series) == ["loss/total", "loss/points", "lr", "eval/all/DET_l"]
    np.testing.assert_array_equal(series["loss/total"][0], [10, 20])
    np.testing.assert_array_equal(series["loss/total"][1], [[9.0], [0.1]])
    np.testing.assert_array_equal(series["eval/all/DET_l"][1], [[0.1, 0.3]])


def test_the_last_record_of_a_step_counts():
    steps, values = curves([{"step": 5, "a": 1}, {"step": 6, "a": 2}, {"step": 5, "a": 3}])["a"]
    np.testing.assert_array_equal(steps, [5, 6])
    np.testing.assert_array_equal(values[:, 0], [3, 2])


@pytest.mark.parametrize("records", [RECORDS, RECORDS[:1], [{"step": 1, "a": float("nan")}]])
def test_curves_are_written(tmp_path, records):
    assert save_curves(tmp_path / "curves.png", records).stat().st_size > 2000


@pytest.mark.parametrize("records", [[], [{"step": 1, "note": "nothing"}]])
def test_no_numbers_is_an_error(tmp_path, records):
    with pytest.raises(UserError, match="nothing to draw"):
        save_curves(tmp_path / "curves.png", records)
