"""Tensors of a published module as parameters of ours, for comparisons with the reference's numbers."""

from tflane_jax.convert.renaming import convert


def converted_params(state, rules):
    """Return the parameters that a module's tensors become; UserError for a tensor that no rule knows."""
    return convert(state, rules, "this module").variables["params"]
