"""Deformable attention at the sizes of the papers against PyTorch's formulation with `grid_sample`.

    python -m benchmarks.deformable --out runs/bench

Forward, and forward with the gradients of value, locations and weights, in float32. Queries are in raster order over
the maps and sample around their own position. If PyTorch is installed, it runs on the same cores in the same
rounds.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import Compiled, command_line, compile_jax, interleave, machine, markdown_table, save, summarise
from tflane_jax.layers.sampling import deformable_attention
from tflane_jax.training.runtime import configure_jax

OURS, TORCH = "ours", "PyTorch"


class Case(NamedTuple):
    """Sizes of one attention.

    Attributes:
        views: stacked maps, each with its own queries (cameras, or previous and present frame).
        queries: of each view.
        channels: of each of the 8 heads.
        points: of each head and level.
        shapes: (h, w) of the levels.
    """

    views: int
    queries: int
    channels: int
    points: int
    shapes: Sequence[tuple[int, int]]


HEADS = 8
CASES = {
    "BEVFormer-small, temporal": Case(2, 22_500, 32, 4, ((150, 150),)),
    "BEVFormer-small, spatial": Case(6, 6_000, 32, 8, ((23, 40),)),
    "TopoNet, temporal": Case(2, 20_000, 32, 4, ((100, 200),)),
    "TopoNet, spatial": Case(7, 4_000, 32, 8, ((100, 128), (50, 64), (25, 32), (13, 16))),
    "TopoNet, decoder": Case(1, 200, 32, 4, ((100, 200),)),
    "small BEV, temporal": Case(2, 1_250, 8, 4, ((25, 50),)),
}


def arrays(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return value, locations, weights and a cotangent of the result."""
    rng = np.random.default_rng(0)
    views, queries, channels, points, shapes = case
    cells, levels = sum(h * w for h, w in shapes), len(shapes)
    place = np.linspace(0.0, 1.0, queries)
    reference = np.stack([place * np.sqrt(queries) % 1.0, place], -1)[None, :, None, None, None]
    offsets = rng.normal(0.0, 3.0, (views, queries, HEADS, levels, points, 2))  # cells
    size = np.array([(w, h) for h, w in shapes])[None, None, None, :, None]
    weights = rng.uniform(size=(views, queries, HEADS, levels, points))
    made = (
        rng.normal(size=(views, cells, HEADS, channels)),
        reference + offsets / size,
        weights / weights.sum((-2, -1), keepdims=True),
        rng.normal(size=(views, queries, HEADS * channels)),
    )
    value, locations, weights, cotangent = (array.astype(np.float32) for array in made)
    return value, locations, weights, cotangent


def programs(case: Case, *, gradient: bool) -> dict[str, Compiled]:
    """Return both sides of a case, ours alone where PyTorch is missing; raise AssertionError where they disagree."""
    value, locations, weights, cotangent = arrays(case)

    def attend(*given: jax.Array) -> jax.Array:
        return deformable_attention(given[0], case.shapes, given[1], given[2])

    def backward(cotangent: jax.Array, *given: jax.Array) -> tuple[jax.Array, ...]:
        # The output too: without it XLA leaves the forward pass out, and PyTorch cannot.
        out, pull = jax.vjp(attend, *given)
        return out, *pull(cotangent)

    given = [jnp.asarray(array) for array in (value, locations, weights)]
    ours = compile_jax(backward, jnp.asarray(cotangent), *given) if gradient else compile_jax(attend, *given)
    if importlib.util.find_spec("torch") is None:
        return {OURS: ours}
    from benchmarks.torch_deformable import program

    theirs = program(value, case.shapes, locations, weights, cotangent if gradient else None)
    for a, b in zip(jax.tree.leaves(ours.program()), theirs(), strict=True):
        # In the mean: at the kinks of a bilinear sample, rounding decides which of two slopes is the gradient.
        assert np.abs(np.asarray(a) - b).mean() < 1e-4 * np.abs(b).mean()
    return {OURS: ours, TORCH: Compiled(theirs, 0.0)}


def measure(seconds: float) -> dict[str, dict[str, Any]]:
    """Return for each case what `timing.summarise` gives, and the seconds of compilation."""
    results: dict[str, dict[str, Any]] = {}
    for name, case in CASES.items():
        for gradient in (False, True):
            compiled = programs(case, gradient=gradient)
            times = summarise(interleave({key: c.program for key, c in compiled.items()}, seconds), OURS)
            rows = {key: row | {"compile_s": compiled[key].seconds} for key, row in times.items()}
            results[f"{name}, {'with gradient' if gradient else 'forward'}"] = rows
    return results


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return one row for each case; above one, ours is faster."""
    header = ("case", "ours, median ms", "least", "PyTorch, median ms", "least", "median of ratios", "ratio of least")
    rows = []
    for case, sides in results.items():
        row = [case, *(f"{sides[OURS][key]:.1f}" for key in ("median_ms", "least_ms"))]
        other = sides.get(TORCH)
        row += [f"{other[key]:.1f}" for key in ("median_ms", "least_ms")] if other else ["-", "-"]
        row += [f"{other[key]:.2f}" for key in ("ratio", "ratio_of_least")] if other else ["-", "-"]
        rows.append(row)
    return markdown_table(header, rows)


def run(out: Path, seconds: float = 10.0) -> None:
    """Measure, print and save."""
    configure_jax(keep_programs=False)  # compiling is timed
    results = measure(seconds)
    record = machine() | {"results": results}  # the load is that at the end
    text = table(record["results"])
    print(text)
    save(out, "deformable", record, text)


if __name__ == "__main__":
    parser = command_line(__doc__, seconds=10.0)
    options = parser.parse_args()
    run(options.out, options.seconds)
