"""Histograms of several datasets."""

from pathlib import Path

import numpy as np
import pytest

from tflane_jax.plots.distributions import save_distributions


def panels(monkeypatch, values):
    """Return the axes that `save_distributions` fills."""
    from tflane_jax.plots import distributions

    kept = []
    monkeypatch.setattr(distributions, "save_figure", lambda figure, path: kept.extend(figure.axes))
    save_distributions(Path("unused.png"), values)
    return kept


@pytest.mark.parametrize("most", [23, 24, 43, 60, 500])
def test_bins_hold_equally_many_whole_numbers(monkeypatch, most):
    """One bin for each of 44 lane counts would be a comb in which nothing can be compared."""
    pytest.importorskip("matplotlib")
    (ax,) = panels(monkeypatch, {"a": {"lanes": np.arange(most + 1.0)}})
    edges = ax.patches[0].get_data().edges
    assert len(edges) <= 25
    assert edges[0] == -0.5
    assert len(np.unique(np.diff(edges))) == 1
    assert np.diff(edges)[0] == round(np.diff(edges)[0])


def test_a_yes_or_no_has_two_ticks(monkeypatch):
    pytest.importorskip("matplotlib")
    (ax,) = panels(monkeypatch, {"a": {"on a connector": np.array([0.0, 1.0, 1.0])}})
    assert ax.get_xticks().tolist() == [0, 1]
    np.testing.assert_allclose(ax.patches[0].get_data().values, [1 / 3, 2 / 3])


def test_values_that_are_not_finite_are_left_out(monkeypatch):
    pytest.importorskip("matplotlib")
    first, second = panels(monkeypatch, {"a": {"x": np.array([np.nan, 0.5, 2.5, np.inf]), "y": np.array([np.nan])}})
    assert first.patches[0].get_data().values.sum() == pytest.approx(1.0)
    assert len(second.patches) == 0


def test_large_values_are_told_apart(monkeypatch):
    """An axis from 0 had both in its last bin."""
    pytest.importorskip("matplotlib")
    (ax,) = panels(monkeypatch, {"a": {"x": np.array([1000.5, 1001.5])}})
    assert sorted(ax.patches[0].get_data().values)[-2:] == [0.5, 0.5]


def test_every_value_is_counted_once(monkeypatch):
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(0)
    values = {"a": {"x": rng.normal(size=40), "n": rng.integers(0, 90, 40) * 1.0}, "b": {"x": rng.normal(size=7)}}
    for ax in panels(monkeypatch, values):
        for patch in ax.patches:
            assert patch.get_data().values.sum() == pytest.approx(1.0)
