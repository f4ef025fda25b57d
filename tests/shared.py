"""What tests of several packages use: reference data (skipped where absent), random arrays, exact comparison."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


def shared_root() -> Path:
    """Return the folder of real data and golden numbers (it may not exist)."""
    return Path(os.environ.get("TFLANE_SHARED", ROOT.parent / "shared"))


def shared_path(relative: str) -> Path:
    """Return a path under the shared folder; skip the calling test, saying why, where it is absent."""
    path = shared_root() / relative
    if not path.exists():
        pytest.skip(f"needs {relative} under TFLANE_SHARED (looked in {shared_root()})")
    return path


def rename(path: Path, name: str) -> Path:
    """Give a file a name that is not UTF-8; skip the calling test where the file system has none (APFS)."""
    try:
        return path.rename(path.with_name(name))
    except OSError as error:
        pytest.skip(f"names of files are UTF-8 here: {error}")


def assert_same(one, other):
    """Assert that the leaves of two trees are exactly equal; NaN equals NaN."""
    jax.tree.map(np.testing.assert_array_equal, one, other)


def random_array(seed, *shape):
    """Return normal numbers, float32, on the device."""
    return jax.numpy.asarray(np.random.default_rng(seed).normal(size=shape).astype(np.float32))


def random_mask(seed, *shape):
    """Return fair coin flips, bool, on the device."""
    return jax.numpy.asarray(np.random.default_rng(seed).random(shape) < 0.5)


def random_photo(height, width):
    """Return noise as an image, uint8."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
