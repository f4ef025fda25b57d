"""The image encoder: views of several sizes, and parameter counts at the papers' sizes from shapes alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.image_encoder import (
    MEAN_RGB,
    PAPER_IMAGE_ENCODER,
    STD_RGB,
    ImageEncoder,
    ImageEncoderConfig,
    image_valid,
    normalise,
)
from tflane_jax.scene import CameraViews

BACKBONE = ResNetConfig((1, 1, 1, 1), (4, 4, 8, 8), stem_channels=4)
SMALL = ImageEncoderConfig(BACKBONE, (2, 3), FeaturePyramidConfig(8, 2))


def views(sizes=((32, 32), (24, 20)), valid=(True, True), shape=(32, 32)):
    n = len(sizes)
    image = np.random.default_rng(0).integers(0, 256, (n, *shape, 3), np.uint8)
    eye = np.broadcast_to(np.eye(4, dtype=np.float32), (n, 4, 4))
    return CameraViews(image, np.array(sizes, np.int32), eye[:, :3, :3], eye, np.array(valid))


@pytest.fixture(scope="module")
def variables():
    return jax.jit(lambda cameras: ImageEncoder(SMALL).init(jax.random.key(0), cameras))(views())


def test_normalisation_is_that_of_imagenet_and_leaves_padding_at_zero():
    cameras = views()
    shown = np.asarray(image_valid(cameras))
    assert shown.sum((1, 2)).tolist() == [32 * 32, 24 * 20]
    assert shown[1, 19, 23]
    assert not shown[1, 20, 23]
    out = np.asarray(normalise(jnp.asarray(cameras.image), jnp.asarray(shown)))
    np.testing.assert_allclose(
        out[shown], ((cameras.image - np.array(MEAN_RGB)) / STD_RGB)[shown], rtol=1e-5, atol=1e-6
    )
    assert not out[~shown].any()


def test_pixels_outside_the_image_change_nothing(variables):
    run = jax.jit(lambda cameras: ImageEncoder(SMALL).apply(variables, cameras))
    cameras = views(valid=(True, False))
    other = cameras.image.copy()
    other[1] = 255 - other[1]
    clean, changed = run(cameras), run(cameras.replace(image=other))
    assert [level.shape for level in clean] == [(2, 2, 2, 8), (2, 1, 1, 8)]
    jax.tree.map(np.testing.assert_array_equal, clean, changed)
    both = views()
    other = both.image.copy()
    other[1, 20:] = 0
    jax.tree.map(np.testing.assert_array_equal, run(both), run(both.replace(image=other)))


def test_an_absent_camera_is_none_at_all_in_training(variables):
    """Norms of the batch: features of two views beside a third that delivers nothing are those of the two."""

    def run(cameras):
        return ImageEncoder(SMALL).apply(variables, cameras, train=True, mutable=["batch_stats"])

    three = views(((32, 32), (24, 20), (32, 32)), (True, True, False))
    two = jax.tree.map(lambda leaf: leaf[:2], three)
    (levels, statistics), (alone, expected) = jax.jit(lambda: (run(three), run(two)))()
    for level, wanted in zip(levels, alone, strict=True):
        np.testing.assert_allclose(level[:2], wanted, rtol=1e-4, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), statistics, expected)


def gradient(variables, config):
    def loss(params):
        encoder = ImageEncoder(config)
        levels, _ = encoder.apply(variables | {"params": params}, views(), train=True, mutable=["batch_stats"])
        return sum(jnp.square(level).mean() for level in levels)

    return jax.value_and_grad(loss)(variables["params"])


def test_remat_and_frozen_stages_change_the_gradient_only_where_they_should(variables):
    # Norms of frozen stages take stored statistics. Where all norms do, freezing changes no other gradient.
    frozen, stored = replace(SMALL, frozen_stages=2), replace(SMALL, backbone=replace(BACKBONE, frozen_norms=True))
    again, stored_frozen = replace(frozen, remat=True), replace(stored, frozen_stages=2)
    run = jax.jit(lambda: [gradient(variables, c) for c in (SMALL, frozen, again, stored, stored_frozen)])
    (_, learned), *pairs = run()
    for (loss, plain), (same, cut) in (pairs[:2], pairs[2:]):
        np.testing.assert_allclose(loss, same, rtol=1e-6)
        every = zip(*(jax.tree_util.tree_leaves_with_path(tree) for tree in (cut, plain, learned)), strict=True)
        for (path, ours), (_, expected), (_, unfrozen) in every:
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            if name.startswith(("backbone/conv1", "backbone/bn1", "backbone/layer1")):
                assert np.abs(unfrozen).max() > 0, name
                assert not np.asarray(ours).any(), name
            else:
                scale = 1e-5 * (1e-3 + np.abs(expected).max())
                np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=scale, err_msg=name)


def test_bfloat16_computes_coarsely_and_keeps_float32_outside(variables):
    coarse = ImageEncoderConfig(BACKBONE, SMALL.stages, SMALL.pyramid, precision="bfloat16")
    fine, rough = (jax.jit(lambda c=c: ImageEncoder(c).apply(variables, views()))() for c in (SMALL, coarse))
    fresh = jax.eval_shape(ImageEncoder(coarse).init, jax.random.key(0), views())
    assert {leaf.dtype for leaf in jax.tree.leaves((fresh, rough))} == {np.dtype("float32")}
    for a, b in zip(fine, rough, strict=True):
        assert 1e-5 < np.abs(a - b).max() / np.abs(a).max() < 0.05


def test_paper_size_has_the_published_parameters():
    cameras = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, views(((1024, 775),) * 7, (True,) * 7, (775, 1024))))
    encoder = ImageEncoder(PAPER_IMAGE_ENCODER)
    levels, fresh = jax.eval_shape(lambda c: encoder.init_with_output(jax.random.key(0), c), cameras)
    assert [level.shape for level in levels] == [
        (7, 97, 128, 256),
        (7, 49, 64, 256),
        (7, 25, 32, 256),
        (7, 13, 16, 256),
    ]
    count = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))  # noqa: E731
    assert count(fresh["params"]["pyramid"]) == 3_278_592
    norms = [
        leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(fresh["batch_stats"])
        if path[-1].key in ("scale", "bias")
    ]
    assert count(fresh["params"]["backbone"]) + count(norms) == 23_508_032
