"""Tables of variants over seeds."""

import numpy as np
import pytest

from tflane_jax.ablations.comparison import compact, summarise
from tflane_jax.ablations.statistics import holm


def scores(*values, seeds=None):
    """Return the scores of a variant by seed, from 0 on."""
    return {
        seed: {"all/DET_l": value, "occluded/DET_l": value / 2}
        for seed, value in zip(seeds or range(len(values)), values, strict=True)
    }


def test_rows():
    rows = summarise({"base": scores(0.1, 0.2), "prior": scores(0.2, 0.4)}, ["all/DET_l"])
    assert [r["model"] for r in rows] == ["base", "prior"]
    assert "difference" not in rows[0]
    assert rows[1]["mean"] == pytest.approx(0.3)
    assert rows[1]["std"] == pytest.approx(np.std([0.2, 0.4], ddof=1))
    assert rows[1]["difference"] == pytest.approx(0.15)
    assert rows[1]["seeds better"] == "2 of 2"


def test_compact_is_in_percent():
    rows = compact({"base": scores(0.1, 0.2).values()}, ["all/DET_l", "occluded/DET_l"])
    assert rows == [{"model": "base", "all/DET_l": "15.0 ± 7.1", "occluded/DET_l": "7.5 ± 3.5"}]
    assert compact({"base": scores(0.1).values()}, ["all/DET_l"]) == [{"model": "base", "all/DET_l": "10.0"}]
    assert compact({"base": scores(0.1, float("nan")).values()}, ["all/DET_l"]) == [
        {"model": "base", "all/DET_l": "n/a"}
    ]


def test_compact_leaves_distances_in_metres():
    both = [{"all/AE_dist": value, "all/AE_type": value} for value in (0.82, 0.84)]
    assert compact({"base": both}, ["all/AE_dist", "all/AE_type"]) == [
        {"model": "base", "all/AE_dist": "0.83 ± 0.01 m", "all/AE_type": "83.0 ± 1.4"}
    ]


def test_a_variant_is_paired_over_the_seeds_that_the_control_has():
    table = {
        "base": scores(0.1, 0.2, 0.3),
        "other order": scores(0.5, 0.2, 0.4, seeds=(2, 0, 1)),
        "two": scores(0.5, 0.2, 0.9, seeds=(1, 2, 7)),
        "one": scores(0.4, seeds=(1,)),
        "none": scores(0.4, 0.6, seeds=(8, 9)),
    }
    _, reordered, two, one, none = summarise(table, ["all/DET_l"])
    assert (reordered["difference"], reordered["seeds better"]) == (pytest.approx((0.1 + 0.2 + 0.2) / 3), "3 of 3")
    assert (two["difference"], two["seeds better"]) == (pytest.approx((0.3 - 0.1) / 2), "1 of 2")
    assert two["mean"] == pytest.approx((0.5 + 0.2 + 0.9) / 3)
    assert (one["difference"], one["seeds better"]) == (pytest.approx(0.2), "1 of 1")
    assert np.isnan(one["p"])
    assert none["mean"] == pytest.approx(0.5)
    assert "difference" not in none
    assert [two["p (Holm)"], reordered["p (Holm)"]] == holm([two["p"], reordered["p"]])


def test_lower_errors_are_better():
    table = {"base": scores(0.1, 0.2, 0.3), "prior": scores(0.05, 0.1, 0.4)}
    (_, row) = summarise(table, ["all/DET_l"], errors=["DET_l"])
    assert row["seeds better"] == "2 of 3"
    assert row["difference"] == pytest.approx(-0.05 / 3)


def test_p_values_are_corrected_for_all_tests_of_the_table():
    table = {"base": scores(0.1, 0.2, 0.3), "a": scores(0.2, 0.35, 0.4), "b": scores(0.1, 0.3, 0.2)}
    rows = [row for row in summarise(table, ["all/DET_l", "occluded/DET_l"]) if "p" in row]
    assert [row["p (Holm)"] for row in rows] == holm([row["p"] for row in rows])
    assert len(rows) == 4
    assert min(row["p (Holm)"] for row in rows) == pytest.approx(4 * min(row["p"] for row in rows))
