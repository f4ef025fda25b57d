"""LSTR's Hungarian fitting loss in PyTorch, for `benchmarks.torch_lstr`; source: docs/reference/lstr.md."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import Any

from scipy.optimize import linear_sum_assignment

from benchmarks.timing import cores
from tflane_jax.errors import UserError

# Weights of the loss terms and of the matching costs.
CLASS, CURVE, EXTENT = 3.0, 5.0, 2.0


def import_torch() -> Any:
    """Return PyTorch, with a thread for each core of this process; raise UserError where it is not installed."""
    # Read when PyTorch is imported. Waiting threads that spin would slow down both sides, PyTorch more than ours.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    try:
        torch = importlib.import_module("torch")
    except ImportError:
        raise UserError("the baseline needs PyTorch: pip install torch") from None
    torch.set_num_threads(cores())
    return torch


def fitting_loss(logits: Any, curves: Any, targets: Sequence[Any]) -> tuple[Any, list[dict[str, Any]]]:
    """Return the loss and, per decoder layer, its terms before weighting (section 2.7); each layer is matched anew.

    Args:
        logits: (layers, B, Q, 2).
        curves: (layers, B, Q, 8).
        targets: per image (n, 3 + 2 P), see `torch_lstr.Batch`.
    """
    torch = import_torch()
    functional = torch.nn.functional
    lanes = max(sum(map(len, targets)), 1)
    total, terms = 0.0, []
    for layer_logits, layer_curves in zip(logits, curves, strict=True):
        pairs = assignment(matching_cost(layer_logits, layer_curves, targets), targets)
        image = torch.cat([torch.full_like(query, b) for b, (query, _) in enumerate(pairs)])
        query = torch.cat([query for query, _ in pairs])
        rows = torch.cat([target[lane] for target, (_, lane) in zip(targets, pairs, strict=True)])
        labels = torch.zeros(layer_logits.shape[:2], dtype=torch.int64)
        labels[image, query] = rows[:, 0].long()
        curve = layer_curves[image, query]
        points, heights, valid = lane_points(rows)
        misfit = (columns(curve[:, None], heights) - points).abs() * lane_weights(valid)[:, None]
        layer = {
            "ce": functional.cross_entropy(layer_logits.flatten(0, 1), labels.flatten()),
            "curves": misfit[valid].sum() / lanes,
            "lowers": (curve[:, 0] - rows[:, 1]).abs().sum() / lanes,
            "uppers": (curve[:, 1] - rows[:, 2]).abs().sum() / lanes,
        }
        total = total + CLASS * layer["ce"] + CURVE * layer["curves"] + EXTENT * (layer["lowers"] + layer["uppers"])
        terms.append(layer)
    return total, terms


def matching_cost(logits: Any, curves: Any, targets: Sequence[Any]) -> Any:
    """Return the cost (B, Q, lanes of the whole batch) of every pair."""
    torch = import_torch()
    with torch.no_grad():
        rows = torch.cat(list(targets))
        points, heights, valid = lane_points(rows)
        probability = logits.softmax(-1)[..., rows[:, 0].long()]
        misfit = (columns(curves[:, :, None, None], heights) - points).abs().masked_fill(~valid, 0.0).sum(-1)
        extent = (curves[:, :, None, :2] - rows[:, 1:3]).abs().sum(-1)
        return -CLASS * probability + CURVE * lane_weights(valid) * misfit + EXTENT * extent


def assignment(cost: Any, targets: Sequence[Any]) -> list[tuple[Any, Any]]:
    """Return per image the matched queries and lanes."""
    torch = import_torch()
    parts = cost.split([len(target) for target in targets], -1)
    found = [linear_sum_assignment(part[b]) for b, part in enumerate(parts)]
    return [(torch.as_tensor(query), torch.as_tensor(lane)) for query, lane in found]


def lane_points(rows: Any) -> tuple[Any, Any, Any]:
    """Return columns, rows and validity of the points of targets."""
    points, heights = rows[:, 3:].chunk(2, 1)
    return points, heights, points >= 0


def lane_weights(valid: Any) -> Any:
    """Return w_l = sqrt(N / N_l) over its largest value; short lanes weigh more."""
    count = valid.sum(-1).float()
    weight = (count.sum() / count).sqrt()
    return weight / weight.max() if len(weight) else weight


def columns(curves: Any, v: Any) -> Any:
    """Return u(v) of curves (..., 8) (section 2.5)."""
    k, f, m, n, b2, b3 = curves[..., 2:].unbind(-1)
    depth = v - f
    return k / depth**2 + m / depth + n + b2 * v - b3
