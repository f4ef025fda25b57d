"""Two batch bugs of the published BEVFormer code, around our modules, which take one example at a time.

The published code (BEVFormer, TopoNet, LaneSegNet, MapTR; in part OpenLane-V2's baseline and SMERF) mixes the elements
of a batch up. Golden cases with several elements hold what it computes, so the harness mixes them up in the same
way: run our module by `vmap(..., axis_name=EXAMPLES)` inside `like_the_reference`.
"""

from contextlib import contextmanager

import flax.linen as nn
import jax.numpy as jnp
from jax import lax

from tflane_jax.layers.bev_attention import SpatialCrossAttention, TemporalSelfAttention
from tflane_jax.layers.geometry_kernel import GeometryKernelAttention

EXAMPLES = "examples"


@contextmanager
def like_the_reference(*, mixed_history: bool = True):
    """Let the BEV attentions of an example read what the published code reads of other examples in the batch.

    Spatial cross-attention takes the queries that a camera serves from the mask of batch element 0, and divides by the
    number of cameras that see a query in its own element. Temporal self-attention (`mixed_history`; not in
    OpenLane-V2's baseline) derives offsets and weights from the first B of [previous 0, present 0, previous 1, ...].
    """

    def intercept(run, args, kwargs, context):
        if context.method_name != "__call__":
            return run(*args, **kwargs)
        if isinstance(context.module, (SpatialCrossAttention, GeometryKernelAttention)):
            return _served_by_the_first(run, args, kwargs, context.module)
        if isinstance(context.module, TemporalSelfAttention) and mixed_history:
            return _mixed_history(run, args, kwargs)
        return run(*args, **kwargs)

    with nn.intercept_methods(intercept):
        yield


def _served_by_the_first(run, args, kwargs, module):
    *others, visible = args
    first = lax.all_gather(visible, EXAMPLES)[0]
    attended = run(*others, first, **kwargs)
    served, own = (jnp.maximum(mask.any(-1).sum(0), 1) for mask in (first, visible))
    bias = module.variables["params"]["output_proj"]["bias"][None]
    return (attended - bias) * (served / own)[:, None] + bias


def _mixed_history(run, args, kwargs):
    _, history, current, *_ = args
    frames = lax.all_gather(jnp.stack([history, current]), EXAMPLES)
    read = frames.reshape(-1, *history.shape)[lax.axis_index(EXAMPLES)]

    def read_other(run, args, kwargs, context):
        if context.module.name in ("sampling_offsets", "attention_weights"):
            args = (jnp.concatenate([read, args[0][:, history.shape[-1] :]], -1),)
        return run(*args, **kwargs)

    with nn.intercept_methods(read_other):
        return run(*args, **kwargs)
