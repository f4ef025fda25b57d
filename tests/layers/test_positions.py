"""Encodings of image positions against the reference's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, implemented, load_module_case, options
from tflane_jax.layers.positions import LearnedImageEncoding, image_sine_encoding

VARIANTS = {
    "detr": {},
    "detr_nonorm": {"normalise": False},
    "mmdet_off": {"offset": -0.5},
    "mmdet_norm": {},
    "mmdet_nonorm": {"normalise": False},
}


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("pe_sine2d*"), ids=case_id)
@pytest.mark.parametrize("variant", VARIANTS)
def test_sine_encoding_matches_the_reference(path, variant):
    case = load_module_case(path)
    if variant not in case.outputs:
        pytest.skip(f"the fixture has no output {variant}")
    found = options(case, "num_feats", temperature=10000)
    implemented(case, scale=[None, 2 * np.pi], eps=[1e-6])
    valid = ~case.inputs["mask"].astype(bool)
    choices = VARIANTS[variant] | {"temperature": float(found.temperature)}
    encode = lambda v: image_sine_encoding(v, found.num_feats, **choices)  # noqa: E731
    ours = np.moveaxis(np.asarray(jax.vmap(encode)(jnp.asarray(valid))), -1, 1)
    # Where a whole row or column is padded, arguments of millions come out.
    seen = (valid.any(1, keepdims=True) & valid.any(2, keepdims=True))[:, None]
    expected = case.outputs[variant]
    np.testing.assert_allclose(np.where(seen, ours, 0), np.where(seen, expected, 0), rtol=2e-5, atol=2e-5)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("pe_sine2d*"), ids=case_id)
def test_every_golden_variant_of_the_encoding_is_supported(path):
    assert load_module_case(path).outputs.keys() <= VARIANTS.keys() | {"learned"}


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("pe_sine2d*"), ids=case_id)
def test_learned_encoding_matches_the_reference(path):
    case = load_module_case(path)
    if "learned" not in case.outputs:
        pytest.skip("the fixture has no learned encoding")
    row, column = case.params["learned.row_embed.weight"], case.params["learned.col_embed.weight"]
    module = LearnedImageEncoding(len(row), len(column), row.shape[1])
    ours = module.apply({"params": {"row": row, "column": column}}, *case.inputs["mask"].shape[1:])
    for expected in case.outputs["learned"]:
        np.testing.assert_array_equal(np.moveaxis(ours, -1, 0), expected)


def test_positions_count_valid_cells_only():
    valid = jnp.zeros((6, 8), bool).at[2:, 3:].set(True)
    inside = image_sine_encoding(jnp.ones((4, 5), bool), 8)
    np.testing.assert_allclose(image_sine_encoding(valid, 8)[2:, 3:], inside, rtol=1e-6)


@pytest.mark.parametrize("shape", [(0, 3), (1, 1)])
def test_small_maps(shape):
    encoding = image_sine_encoding(jnp.ones(shape, bool), 4)
    assert encoding.shape == (*shape, 8)
    assert np.isfinite(encoding).all()


def test_learned_positions_name_the_largest_map():
    module = LearnedImageEncoding(2, 3, 4)
    with pytest.raises(ValueError, match="up to 2 x 3, not 4 x 3"):
        module.init(jax.random.key(0), 4, 3)
