"""Colours of curves can be told apart, also by people who see no difference between red and green."""

import itertools

import numpy as np
import pytest

from tflane_jax.plots import style

# What people without green cones see of linear red, green and blue (Machado, Oliveira and Fernandes, 2009).
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour: str, seen: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* of a colour "#rrggbb" after a matrix in linear light."""
    values = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(seen @ linear, 0.0, 1.0) / TO_XYZ.sum(1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPIA], ids=["all cones", "no green cones"])
def test_curves_are_told_apart(seen):
    """matplotlib's green and red are 7 apart for people without green cones; a difference of 2 can just be seen."""
    apart = {(a, b): np.linalg.norm(lab(a, seen) - lab(b, seen)) for a, b in itertools.combinations(style.SERIES, 2)}
    assert min(apart.values()) > 14.0


def test_a_colour_comes_again_with_another_line():
    looks = [tuple(style.curve_style(number).values()) for number in range(3 * len(style.SERIES))]
    assert len(set(looks)) == len(looks)
