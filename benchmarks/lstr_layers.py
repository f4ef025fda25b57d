"""What the convolutions of LSTR cost in a training step, kernel by kernel, and what else computes them.

    python -m benchmarks.lstr_layers --out runs/bench

Forward, kernel gradient and input gradient of every kernel shape of the network at its full size. Beside XLA's own
convolution: the same with channels first, the kernel gradient as one matrix product for each position of the kernel,
and as one product with the copied windows (im2col). PyTorch, where it is installed, has channels last. All give the
same numbers, or the benchmark stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.lstr import TRAINING_BATCH, with_torch
from benchmarks.timing import Compiled, command_line, compile_jax, machine, markdown_table, measure, save
from benchmarks.torch_fitting import import_torch

XLA, FIRST, PRODUCTS, IM2COL, TORCH = "XLA", "channels first", "a product for each position", "im2col", "PyTorch"
PARTS = ("forward", "kernel gradient", "input gradient")


class Layer(NamedTuple):
    """A convolution: input (h, w, c), kernel k x k x out, stride; `count` of them are in the network."""

    name: str
    height: int
    width: int
    channels: int
    out: int
    stride: int = 1
    k: int = 3
    count: int = 1

    @property
    def padding(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Before and after, of rows and columns; the stem's 4x4 kernel reads two cells before and one behind."""
        before, after = self.k // 2, (self.k - 1) // 2
        return (before, after), (before, after)


LAYERS = (
    Layer("stem, 7x7, stride 2", 360, 640, 3, 16, 2, 7),
    Layer("stem, 4x4 on blocks of 2x2", 180, 320, 12, 16, 1, 4),
    Layer("stage 1", 90, 160, 16, 16, count=2),
    Layer("stage 2, first", 90, 160, 16, 32, 2),
    Layer("stage 2", 45, 80, 32, 32, count=3),
    Layer("stage 3, first", 45, 80, 32, 64, 2),
    Layer("stage 3", 23, 40, 64, 64, count=3),
    Layer("stage 4, first", 23, 40, 64, 128, 2),
    Layer("stage 4", 12, 20, 128, 128, count=3),
)


def convolve(layer: Layer, x: Any, kernel: Any) -> Any:
    """Return XLA's convolution of (B, H, W, C)."""
    layout = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(x, kernel, (layer.stride,) * 2, layer.padding, dimension_numbers=layout)


def channels_first(layer: Layer, x: Any, kernel: Any) -> Any:
    """Return the convolution of (B, C, H, W)."""
    layout = ("NCHW", "OIHW", "NCHW")
    return lax.conv_general_dilated(x, kernel, (layer.stride,) * 2, layer.padding, dimension_numbers=layout)


def windows(layer: Layer, x: Any, height: int, width: int) -> list[Any]:
    """Return for each position of the kernel the cells that it meets, (B, height, width, C)."""
    x, s = jnp.pad(x, [(0, 0), *layer.padding, (0, 0)]), layer.stride
    places = np.ndindex(layer.k, layer.k)
    return [x[:, i : i + s * (height - 1) + 1 : s, j : j + s * (width - 1) + 1 : s] for i, j in places]


def kernel_gradient(layer: Layer, way: str, x: Any, gradient: Any) -> Any:
    """Return the gradient of the kernel (k, k, C, out) from matrix products."""
    _, height, width, out = gradient.shape
    seen, flat = windows(layer, x, height, width), gradient.reshape(-1, out)
    if way == IM2COL:
        found = jnp.concatenate(seen, -1).reshape(len(flat), -1).T @ flat
    else:
        found = jnp.stack([cells.reshape(-1, layer.channels).T @ flat for cells in seen])
    return found.reshape(layer.k, layer.k, layer.channels, out)


def pulled_back(function: Callable[..., Any], argument: int) -> Callable[..., Any]:
    """Return the gradient of a function of (x, kernel) to one argument, from the gradient of its output."""

    def back(x: Any, kernel: Any, gradient: Any) -> Any:
        fixed = (lambda y: function(y, kernel)) if argument == 0 else (lambda y: function(x, y))
        return jax.vjp(fixed, (x, kernel)[argument])[1](gradient)[0]

    return back


def programs(layer: Layer, batch: int) -> dict[str, dict[str, Compiled]]:
    """Return the ways to compute each part, which have given the same numbers."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(batch, layer.height, layer.width, layer.channels)).astype(np.float32)
    kernel = rng.normal(size=(layer.k, layer.k, layer.channels, layer.out)).astype(np.float32)
    ours, first = partial(convolve, layer), partial(channels_first, layer)
    gradient = rng.normal(size=jax.eval_shape(ours, x, kernel).shape).astype(np.float32)
    x1, gradient1 = (a.transpose(0, 3, 1, 2).copy() for a in (x, gradient))
    kernel1 = kernel.transpose(3, 2, 0, 1).copy()
    others = (PRODUCTS, IM2COL) if layer.k == 3 else ()  # the windows of the stem take half a gigabyte
    found = {
        "forward": {XLA: compile_jax(ours, x, kernel), FIRST: compile_jax(first, x1, kernel1)},
        "kernel gradient": {
            XLA: compile_jax(pulled_back(ours, 1), x, kernel, gradient),
            FIRST: compile_jax(pulled_back(first, 1), x1, kernel1, gradient1),
            **{way: compile_jax(partial(kernel_gradient, layer, way), x, gradient) for way in others},
        },
    }
    if not layer.name.startswith("stem"):  # nobody needs the gradient of the image
        found["input gradient"] = {
            XLA: compile_jax(pulled_back(ours, 0), x, kernel, gradient),
            FIRST: compile_jax(pulled_back(first, 0), x1, kernel1, gradient1),
        }
    if with_torch() and layer.k % 2:
        for part, program in torch_programs(layer, x1, kernel1, gradient1).items():
            found.get(part, {})[TORCH] = program
    for part, ways in found.items():
        back = (2, 3, 1, 0) if part == "kernel gradient" else (0, 2, 3, 1)
        expected = np.asarray(ways[XLA].program())
        for way, entry in ways.items():
            value = np.asarray(entry.program())
            value = value.transpose(back) if way in (FIRST, TORCH) else value
            np.testing.assert_allclose(value, expected, rtol=0.0, atol=1e-4 * np.abs(expected).max())
    return found


def torch_programs(layer: Layer, x: Any, kernel: Any, gradient: Any) -> dict[str, Compiled]:
    """Return PyTorch's programs with channels last in memory."""
    torch = import_torch()
    last = torch.channels_last
    x, kernel, gradient = (torch.from_numpy(a).contiguous(memory_format=last) for a in (x, kernel, gradient))
    options = {"stride": layer.stride, "padding": layer.k // 2}
    grad = torch.nn.grad
    return {
        "forward": Compiled(lambda: torch.nn.functional.conv2d(x, kernel, **options), 0.0),
        "kernel gradient": Compiled(lambda: grad.conv2d_weight(x, kernel.shape, gradient, **options), 0.0),
        "input gradient": Compiled(lambda: grad.conv2d_input(x.shape, kernel, gradient, **options), 0.0),
    }


def table(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return a row for each layer and part: XLA's milliseconds, and how many times as long the other ways take."""
    others = (FIRST, PRODUCTS, IM2COL, TORCH)
    rows = [
        [layer, part, f"{ways[XLA]['median_ms']:.2f}", f"{ways[XLA]['least_ms']:.2f}"]
        + [f"{ways[way]['ratio']:.2f}" if way in ways else "-" for way in others]
        for layer, parts in results.items()
        for part, ways in parts.items()
    ]
    return markdown_table(("layer", "part", "XLA, median ms", "least ms", *(f"{way}, ratio" for way in others)), rows)


def run(out: Path, seconds: float = 2.0, batch: int = TRAINING_BATCH, layers: Sequence[Layer] = LAYERS) -> None:
    """Measure, print and save."""
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for layer in layers:
        name = f"{layer.count} x {layer.name}" if layer.count > 1 else layer.name
        print(name, flush=True)
        results[name] = {part: measure(ways, seconds) for part, ways in programs(layer, batch).items()}
    text = table(results)
    print(text)
    save(out, "lstr_layers", machine() | {"batch": batch, "results": results}, text)


if __name__ == "__main__":
    parser = command_line(__doc__, seconds=2.0)
    parser.add_argument("--batch", type=int, default=TRAINING_BATCH, help="images (default 16)")
    options = parser.parse_args()
    run(options.out, options.seconds, options.batch)
