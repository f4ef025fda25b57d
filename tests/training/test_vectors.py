"""Trees as vectors and back: exact, for any shapes, with leading axes, in numpy and under jit."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tflane_jax.errors import UserError
from tflane_jax.training.vectors import ROW, Vectors, any_in_leaf, layout_of, norm, ravel

SHAPES = {
    "a": {"kernel": (5, 13), "bias": (13,)},
    "b": {"kernel": (3, 3, 2, 4), "bias": (4,)},
    "attention": {"kernel": (2, 4, 3), "bias": (2, 3)},
    "c": {"kernel": (13, 5), "bias": (5,)},
    "d": {"kernel": (5, 13)},
    "norm": {"scale": (64,)},
    "temperature": (),
    "nothing": {"kernel": (0, 3)},
}
GROUPS = {"dense", "convolution", "other", "plain"}


def example(lead=(), xp=np):
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda shape: xp.asarray(rng.normal(size=lead + shape).astype(np.float32)),
        SHAPES,
        is_leaf=lambda node: isinstance(node, tuple),
    )


@pytest.mark.parametrize("lead", [(), (3,)])
@pytest.mark.parametrize("xp", [np, jnp])
def test_a_tree_comes_back_exactly(lead, xp):
    layout, tree = layout_of(example()), example(lead, xp)
    vectors = ravel(tree, layout)
    assert set(vectors.groups) == GROUPS
    assert all(isinstance(v, jax.Array) == (xp is jnp) and v.shape[:-1] == lead for v in vectors.groups.values())
    jax.tree.map(np.testing.assert_array_equal, vectors.tree(), tree)
    again = jax.jit(lambda tree: ravel(tree, layout).tree())(tree)
    jax.tree.map(np.testing.assert_array_equal, again, tree)


def test_layouts_of_equal_trees_are_equal():
    assert layout_of(example()) == layout_of(example(xp=jnp))
    assert hash(layout_of(example())) == hash(layout_of(jax.eval_shape(example)))
    assert layout_of(example()) != layout_of({"a": example()["a"]})


def test_kernels_of_a_shape_are_a_stack():
    tree = example()
    vectors = ravel(tree, layout_of(tree))
    stacks = {stack.shape: stack for stack in vectors.layout.stacks("dense")}
    assert {shape: stack.count for shape, stack in stacks.items()} == {(5, 13): 2, (13, 5): 1}
    (first,) = (stack for shape, stack in stacks.items() if shape == (5, 13))
    for i, name in enumerate("ad"):
        start = (first.row + i * first.rows) * ROW
        found = vectors.groups["dense"][start : start + 65].reshape(5, 13)
        np.testing.assert_array_equal(found, tree[name]["kernel"])
    assert [stack.shape for stack in vectors.layout.stacks("convolution")] == [(18, 4)]


def test_masked_groups_are_masked_leaves():
    tree = example()
    vectors = ravel(tree, layout_of(tree)).map(lambda group, v: optax.MaskedNode() if group == "dense" else v)
    found = vectors.tree()
    assert isinstance(found["a"]["kernel"], optax.MaskedNode)
    np.testing.assert_array_equal(found["b"]["kernel"], tree["b"]["kernel"])
    back = ravel(found, vectors.layout)
    assert isinstance(back.groups["dense"], optax.MaskedNode)
    jax.tree.map(np.testing.assert_array_equal, back, vectors)


def test_norm_is_that_of_the_tree():
    tree = example()
    expected = np.sqrt(sum(np.square(leaf.astype(float)).sum() for leaf in jax.tree.leaves(tree)))
    np.testing.assert_allclose(norm(ravel(tree, layout_of(tree))), expected, rtol=1e-6)
    assert norm(Vectors({}, layout_of({}))) == 0


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_any_in_leaf_is_by_leaf(group):
    layout, tree = layout_of(example()), jax.tree.map(np.zeros_like, example())
    for change in ("a", "b", "attention", "norm"):
        for leaf in tree[change].values():
            leaf.reshape(-1)[-1] = 1.0
    expected = jax.tree.map(lambda leaf: np.full(leaf.shape, leaf.any(), np.float32), tree)
    found = jax.jit(lambda vector: any_in_leaf(vector, layout, group))(ravel(tree, layout).groups[group] != 0)
    flags = ravel(tree, layout).map(lambda other, v: np.asarray(found, np.float32) if other == group else 0 * v)
    for place, leaf, wanted in zip(
        layout.places, jax.tree.leaves(flags.tree()), jax.tree.leaves(expected), strict=True
    ):
        if place.group == group:
            np.testing.assert_array_equal(leaf, wanted)


def test_rows_of_zeros_at_the_end_belong_to_no_leaf():
    tree = example()
    plain = ravel(tree, layout_of(tree)).map(lambda group, v: optax.MaskedNode() if group == "other" else v)
    padded = plain.padded(5)
    assert all(len(v) % (5 * ROW) == 0 for v in padded.groups.values() if not isinstance(v, optax.MaskedNode))
    assert isinstance(padded.groups["other"], optax.MaskedNode)
    assert padded.padded(5) is padded
    jax.tree.map(np.testing.assert_array_equal, padded.tree(), plain.tree())
    jax.tree.map(np.testing.assert_array_equal, ravel(padded.tree(), padded.layout), padded)
    whole = len(plain.groups["plain"])
    flags = [any_in_leaf(v.groups["plain"] != 0, v.layout, "plain") for v in (plain, padded)]
    assert len(flags[1]) == len(padded.groups["plain"]) > whole
    np.testing.assert_array_equal(flags[1][:whole], flags[0])


def test_parameters_are_float32():
    with pytest.raises(UserError, match=r"line/kernel is float16.*param_dtype"):
        layout_of({"line": {"kernel": np.zeros((2, 2), np.float16)}})
