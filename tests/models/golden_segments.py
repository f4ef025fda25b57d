"""The fixtures of LaneSegNet's head as arguments of our modules and losses."""

import jax.numpy as jnp
import numpy as np

from tests.golden import implemented, numbered, options
from tflane_jax.models.lane_segments import SegmentDecoderConfig
from tflane_jax.models.segment_truth import SegmentTargets
from tflane_jax.scene import stack_examples


def decoder_config(case):
    needed = ("dim", "layers", "queries", "lane_points", "hidden", "lane_attn_heads", "lane_attn_points")
    sizes = options(case, *needed, classes=2)
    implemented(case, classes=[2, 1], self_attn_heads=[sizes.lane_attn_heads])
    along = np.linspace(0, sizes.lane_points - 1, sizes.lane_attn_heads // 2).round().astype(int).tolist()
    implemented(case, sample_idx=[along])
    return SegmentDecoderConfig(
        dim=sizes.dim,
        heads=sizes.lane_attn_heads,
        layers=sizes.layers,
        queries=sizes.queries,
        points=sizes.lane_points,
        sampling_points=sizes.lane_attn_points,
        hidden=sizes.hidden,
        classes=sizes.classes,
    )


def targets(case):
    """Return the fixture's targets and their masks, padded and stacked over images."""
    images = [name.removeprefix("gt_lanes.") for name in numbered(case.inputs, r"gt_lanes\.(\d+)")]
    # One more than the fullest image has, so that every image has padding.
    capacity = 1 + max(len(case.inputs[f"gt_lanes.{image}"]) for image in images)
    return stack_examples([_targets({k: case.inputs[f"gt_{k}.{image}"] for k in _PARTS}, capacity) for image in images])


_PARTS = ("lanes", "labels", "masks", "left_type", "right_type")


def _targets(arrays, capacity):
    count = len(arrays["lanes"])
    pad = lambda array: np.concatenate([array, np.zeros((capacity - count, *array.shape[1:]), array.dtype)])  # noqa: E731
    lines = (pad(line) for line in arrays["lanes"].reshape(count, 3, -1, 3).swapaxes(0, 1))
    labels = (pad(arrays[name].astype(np.int32)) for name in ("labels", "left_type", "right_type"))
    return SegmentTargets(*lines, *labels, np.zeros((capacity,) * 2, bool), pad(np.ones(count, bool))), pad(
        arrays["masks"]
    )


def segments_by_name(segments, queries):
    """Return predictions (B, D, ...) by the reference's names, (D, B, ...)."""
    shape = (*segments.points.shape[:3], -1)
    lines = [line.reshape(shape) for line in (segments.points, segments.left, segments.right)]
    out = {
        "all_cls_scores": segments.logits,
        "all_lanes_preds": jnp.concatenate(lines, -1),
        "all_lanes_left_type": segments.left_type_logits,
        "all_lanes_right_type": segments.right_type_logits,
        "history_states": queries,
    }
    if segments.mask_logits is not None:
        out["all_mask_preds"] = segments.mask_logits
    return {name: value.swapaxes(0, 1) for name, value in out.items()}
