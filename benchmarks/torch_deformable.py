"""Multi-scale deformable attention in PyTorch as the reference runs it without CUDA: a `grid_sample` for each level.

Source: Zhu et al. 2021 (Deformable DETR), Eq. (3). PyTorch is imported when a program is made, and is no
dependency of the project.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.torch_fitting import import_torch


def attend(value: Any, shapes: Sequence[tuple[int, int]], locations: Any, weights: Any) -> Any:
    """Return the attended features (V, Q, heads * d).

    Args:
        value: (V, HW, heads, d), levels one after the other.
        shapes: (h, w) of each level.
        locations: (V, Q, heads, levels, P, 2), (x, y) in [0, 1].
        weights: (V, Q, heads, levels, P).
    """
    torch = import_torch()
    views, queries, heads, _, points = weights.shape
    sampled = []
    parts = value.split([h * w for h, w in shapes], 1)
    for level, ((h, w), part) in enumerate(zip(shapes, parts, strict=True)):
        image = part.permute(0, 2, 3, 1).reshape(views * heads, -1, h, w)
        grid = (2.0 * locations[:, :, :, level] - 1.0).transpose(1, 2).reshape(views * heads, queries, points, 2)
        sampled.append(
            torch.nn.functional.grid_sample(image, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        )
    weight = weights.transpose(1, 2).reshape(views * heads, 1, queries, -1)
    total = (torch.cat(sampled, -1) * weight).sum(-1)
    return total.reshape(views, -1, queries).transpose(1, 2).contiguous()


def program(
    value: np.ndarray,
    shapes: Sequence[tuple[int, int]],
    locations: np.ndarray,
    weights: np.ndarray,
    cotangent: np.ndarray | None = None,
) -> Callable[[], list[np.ndarray]]:
    """Return a program for the attended features and, with their cotangent, for the gradients of all three arrays."""
    torch = import_torch()
    arrays = [torch.from_numpy(array.copy()) for array in (value, locations, weights)]
    if cotangent is None:

        def forward() -> list[np.ndarray]:
            with torch.no_grad():
                return [attend(arrays[0], shapes, arrays[1], arrays[2]).numpy()]

        return forward
    given = torch.from_numpy(cotangent.copy())
    for array in arrays:
        array.requires_grad_()

    def backward() -> list[np.ndarray]:
        out = attend(arrays[0], shapes, arrays[1], arrays[2])
        return [out.detach().numpy(), *(gradient.numpy() for gradient in torch.autograd.grad(out, arrays, given))]

    return backward
