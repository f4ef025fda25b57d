"""Distances of two polylines (n, d) and (m, d) as they are defined, by plain loops."""

import functools

import numpy as np


def frechet(a, b):
    """Return the discrete Fréchet distance, by the recursion of Eiter & Mannila (1994)."""

    @functools.cache
    def coupling(i, j):
        here = float(np.sqrt(((a[i] - b[j]) ** 2).sum()))
        before = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
        before = [coupling(*cell) for cell in before if min(cell) >= 0]
        return max(here, min(before)) if before else here

    return coupling(len(a) - 1, len(b) - 1)


def chamfer(a, b):
    """Return half the sum of the mean distances from each vertex to the nearest vertex of the other line."""
    forward = [min(np.linalg.norm(p - q) for q in b) for p in a]
    backward = [min(np.linalg.norm(p - q) for p in a) for q in b]
    return 0.5 * (np.mean(forward) + np.mean(backward))


def all_pairs(distance, first, second):
    """Return the distances of all pairs of lines, (len(first), len(second))."""
    return np.array([[distance(a, b) for b in second] for a in first]).reshape(len(first), len(second))
