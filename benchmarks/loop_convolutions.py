"""Gradients of convolutions inside a loop: what the rewriting of `training.loop_convolutions` brings on this machine.

    python -m benchmarks.loop_convolutions --out runs/bench

Three 3 x 3 convolutions of 32 channels on two maps of 32 x 64, gradients added up over four parts.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.timing import command_line, compile_jax, machine, markdown_table, measure, save
from tflane_jax.training.loop_convolutions import with_fast_convolutions

PARTS = 4


def loss(kernels: jax.Array, x: jax.Array) -> jax.Array:
    """Return a number that depends on three convolutions."""
    for i in range(len(kernels)):
        x = jax.nn.relu(
            lax.conv_general_dilated(x, kernels[i], (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
        )
    return (x**2).mean()


def gradient(kernels: jax.Array, parts: jax.Array, *, unroll: int) -> jax.Array:
    """Return the sum of the gradients of all parts."""

    def body(total: jax.Array, x: jax.Array):
        return total + jax.grad(loss)(kernels, x), None

    return lax.scan(body, jnp.zeros_like(kernels), parts, unroll=unroll)[0]


def run(out: Path, seconds: float = 20.0) -> dict[str, Any]:
    """Compare the three forms, print the table, and write `loop_convolutions.json` and `.md` into `out`."""
    rng = np.random.default_rng(0)
    kernels = 0.05 * rng.normal(size=(3, 3, 3, 32, 32)).astype(np.float32)
    parts = rng.normal(size=(PARTS, 2, 32, 64, 32)).astype(np.float32)
    forms = {
        "unrolled": partial(gradient, unroll=PARTS),
        "loop": partial(gradient, unroll=1),
        "loop, rewritten": with_fast_convolutions(partial(gradient, unroll=1)),
    }
    rows = measure({name: compile_jax(form, kernels, parts) for name, form in forms.items()}, seconds)
    header = ["form", "compile s", "median ms", "ratio"]
    lines = [[n, f"{r['compile_s']:.1f}", f"{r['median_ms']:.0f}", f"{r['ratio']:.2f}"] for n, r in rows.items()]
    text = markdown_table(header, lines)
    print(text)
    record = machine() | {"forms": rows}
    save(out, "loop_convolutions", record, text)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=20.0)
    options = parser.parse_args()
    run(options.out, options.seconds)


if __name__ == "__main__":
    main()
