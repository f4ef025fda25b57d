"""Tables of variants over seeds."""

import numpy as np
import pytest

from tflane_jax.ablations.comparison import Variant, compact, summarise
from tflane_jax.ablations.statistics import holm
from tflane_jax.errors import UserError


def variant(name, *values):
    return Variant(name, tuple({"all/DET_l": v, "occluded/DET_l": v / 2} for v in values))


def test_rows():
    rows = summarise([variant("base", 0.1, 0.2), variant("prior", 0.2, 0.4)], ["all/DET_l"])
    assert [r["model"] for r in rows] == ["base", "prior"]
    assert "difference" not in rows[0]
    assert rows[1]["mean"] == pytest.approx(0.3)
    assert rows[1]["std"] == pytest.approx(np.std([0.2, 0.4], ddof=1))
    assert rows[1]["difference"] == pytest.approx(0.15)
    assert rows[1]["seeds better"] == "2 of 2"


def test_compact_is_in_percent():
    rows = compact(
        [
            variant("base", 0.1, 0.2),
        ],
        ["all/DET_l", "occluded/DET_l"],
    )
    assert rows == [{"model": "base", "all/DET_l": "15.0 ± 7.1", "occluded/DET_l": "7.5 ± 3.5"}]
    assert compact([variant("base", 0.1)], ["all/DET_l"]) == [{"model": "base", "all/DET_l": "10.0"}]
    assert compact([variant("base", 0.1, float("nan"))], ["all/DET_l"]) == [{"model": "base", "all/DET_l": "n/a"}]


def test_unequal_seeds_cannot_be_paired():
    with pytest.raises(UserError, match="base: 2, prior: 1"):
        summarise([variant("base", 0.1, 0.2), variant("prior", 0.2)], ["all/DET_l"])


def test_lower_errors_are_better():
    variants = [variant("base", 0.1, 0.2, 0.3), variant("prior", 0.05, 0.1, 0.4)]
    (_, row) = summarise(variants, ["all/DET_l"], errors=["all/DET_l"])
    assert row["seeds better"] == "2 of 3"
    assert row["difference"] == pytest.approx(-0.05 / 3)


def test_p_values_are_corrected_for_all_tests_of_the_table():
    variants = [variant("base", 0.1, 0.2, 0.3), variant("a", 0.2, 0.35, 0.4), variant("b", 0.1, 0.3, 0.2)]
    rows = [row for row in summarise(variants, ["all/DET_l", "occluded/DET_l"]) if "p" in row]
    assert [row["p (Holm)"] for row in rows] == holm([row["p"] for row in rows])
    assert len(rows) == 4
    assert min(row["p (Holm)"] for row in rows) == pytest.approx(4 * min(row["p"] for row in rows))
