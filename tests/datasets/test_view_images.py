"""Resizing of camera images."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.datasets.view_images import LANESEGNET_BUCKET, ImageConfig, fit_image


@pytest.mark.parametrize(("shrink", "expected"), [("area", 85.0), ("bilinear", 255.0)])
def test_images_below_half_size_are_averaged_or_sampled(shrink, expected):
    """One white column of three: an average sees a third of it, a sample at its center all of it."""
    image = np.zeros((9, 9, 3), np.uint8)
    image[:, 1::3] = 255
    fit = fit_image(9, 9, ImageConfig(scale=1 / 3 + 1e-9, shrink=shrink), front=False)
    np.testing.assert_allclose(fit.image(image), expected, atol=1)


def test_the_bucket_variant_samples_as_its_code_does():
    assert LANESEGNET_BUCKET.shrink == "bilinear"
    fit = fit_image(2048, 1550, LANESEGNET_BUCKET, front=False)
    assert (fit.shrink, fit.size) == ("bilinear", (675, 511))


@pytest.mark.parametrize("shrink", ["area", "bilinear"])
def test_half_size_is_bilinear_in_both(shrink):
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    plain = ImageConfig(scale=0.5)
    fits = [fit_image(30, 20, config, front=False) for config in (plain, replace(plain, shrink=shrink))]
    np.testing.assert_array_equal(*(fit.image(image) for fit in fits))
