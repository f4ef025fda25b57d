"""The fixtures of MapTR's head as arguments of our modules and losses."""

import jax.numpy as jnp
import numpy as np

from tests.golden import implemented, numbered, options
from tests.models.golden_bev import golden_views
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.losses.maptr import LineTargets
from tflane_jax.models.bev_encoder import BevFormerConfig, BevMemory
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.scene import stack_examples


def perception_range(case):
    low, high = np.array(options(case, "pc_range").pc_range).reshape(2, 3)
    return PerceptionRange(*map(tuple, zip(low.tolist(), high.tolist(), strict=True)))


def encoder_config(case):
    """Return the BEV encoder; sizes that `meta` does not tell are read from the shapes of the parameters."""
    implemented(case, encoder=["gkt", "bevformer"])
    found = options(case, "dim", "heads", "bev", "cams", "hidden", "encoder", "rotate_center")
    layers = r"transformer\.encoder\.layers\."
    count = len(numbered(case.params, layers + r"(\d+)\.norms\.0\.weight"))
    below = "transformer.encoder.layers.0.attentions."
    temporal = len(case.params[f"{below}0.sampling_offsets.bias"]) // (2 * 2 * found.heads)
    sizes = {"attention": "kernel"}
    if found.encoder == "bevformer":
        points = len(case.params[f"{below}1.deformable_attention.sampling_offsets.bias"]) // (2 * found.heads)
        sizes = {"attention": "deformable", "spatial_points": points}
    bev = BevFormerConfig(
        BevGrid(perception_range(case), *found.bev),
        found.dim,
        found.heads,
        count,
        found.hidden,
        dropout=0.0,
        temporal_points=temporal,
        levels=1,
        cameras=found.cams,
        align="bevformer",
        rotation_center=tuple(found.rotate_center),
        temporal_value="initial",
        **sizes,
    )
    return CameraEncoderConfig(bev=bev)


def encoder_inputs(case):
    """Return views, an empty memory and no shift for every batch element."""
    views, config = golden_views(case.inputs), encoder_config(case).bev
    batch = len(views.valid)
    past = jnp.zeros((batch, config.grid.rows, config.grid.columns, config.dim))
    return views, BevMemory(past, jnp.zeros(batch, bool)), jnp.zeros((batch, 2))


def decoder_config(case):
    """Return the decoder; the coordinates of a point are those of the initial points."""
    sizes = options(case, "dim", "heads", "layers", "hidden", "points", "classes", num_vec=None, one2one=None)
    return LineDecoderConfig(
        dim=sizes.dim,
        heads=sizes.heads,
        layers=sizes.layers,
        queries=sizes.num_vec or sizes.one2one,
        points=sizes.points,
        coordinates=len(case.params["transformer.reference_points.bias"]),
        classes=sizes.classes,
        hidden=sizes.hidden,
    )


def targets(case):
    """Return the fixture's lines with their orders, padded and stacked over images."""
    images = [name.rpartition(".")[2] for name in numbered(case.inputs, r"gt_shift_pts\.(\d+)")]
    # One more than the fullest image has, so that every image has padding.
    capacity = 1 + max(len(case.inputs[f"gt_labels.{image}"]) for image in images)
    return stack_examples(
        [
            line_targets(case.inputs[f"gt_shift_pts.{image}"], case.inputs[f"gt_labels.{image}"], capacity)
            for image in images
        ]
    )


def line_targets(orders, labels, capacity):
    """Return targets from the reference's orders, of which -10000 stands for no order."""
    pad = lambda array: np.concatenate([array, np.zeros((capacity - len(labels), *array.shape[1:]), array.dtype)])  # noqa: E731
    real = (orders > -9999).all((2, 3))
    return LineTargets(
        pad(np.where(real[..., None, None], orders, 0.0).astype(np.float32)),
        pad(real),
        pad(labels.astype(np.int32)),
        np.arange(capacity) < len(labels),
    )


def lines_by_name(lines, range_):
    """Return predictions (B, D, ...) by the reference's names, (D, B, ...); boxes are (cx, cy, w, h) of x and y."""
    unit = range_.normalise(lines.points)
    low, high = unit[..., :2].min(-2), unit[..., :2].max(-2)
    out = {
        "all_cls_scores": lines.logits,
        "all_pts_preds": unit,
        "all_bbox_preds": jnp.concatenate([(low + high) / 2, high - low], -1),
    }
    return {name: value.swapaxes(0, 1) for name, value in out.items()}
