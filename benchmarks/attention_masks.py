"""How to mask the attention of the traffic-flow module: one large mask, its quadrants, our attention or a library's.

    python -m benchmarks.attention_masks --out runs/bench

TF-Lane's M_s (section 3.3, Fig. 5) is an (L+T) x (L+T) matrix of which each fusion module uses one quadrant. Three
results are compared; a ratio never crosses from one to another:

- `LT/LL`: lanes attend to traffic, then to lanes; one softmax per quadrant (Table 5, "LT/LL").
- `All`: T->T, T->L, L->T, L->L in turn; one softmax per quadrant (Table 5, "All").
- `joint`: one attention over all L+T tokens under the whole M_s, one softmax over lanes and traffic together. Not what
  the paper describes; the textbook use of such a matrix.

For the first two, "quadrants" gives each attention its own queries and keys; "dense" runs each over all L+T tokens
under a mask that is false outside its quadrant. Forward, and forward with the gradient of both inputs. Tokens enter as
the projections leave them (batch, tokens, heads, channels). All results are checked against each other first.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.timing import (
    Compiled,
    command_line,
    compile_jax,
    cores,
    interleave,
    machine,
    markdown_table,
    save,
    summarise,
)
from benchmarks.torch_fitting import import_torch
from tflane_jax.errors import UserError
from tflane_jax.layers.attention import masked_attention
from tflane_jax.layers.masks import SpatialMask

Result = Literal["LT/LL", "All", "joint"]
Tokens = Float[Array, "b n h d"]
Attend = Callable[[Any, Any, Any, Any], Any]

RESULTS: tuple[Result, ...] = ("LT/LL", "All", "joint")
LANES = (50, 200, 4000)
TRAFFIC, HEADS, CHANNELS = 30, 8, 32
OURS = "ours"
# One example's weights over 4,000 x 4,000 tokens fill half a gigabyte where they are kept. Above this number of lane
# tokens: batch 1 only, and the dense forms only in `joint`, where each runs once.
LARGEST_DENSE = 1000
# Largest difference, relative to 1 + the largest value. Against float64 every variant stays below 7.2e-6 (LT/LL at 50,
# 200 and 4,000 lanes; All and joint at 50 and 200), ours no further off than the libraries, so that two of them may be
# 1.4e-5 apart by rounding alone.
TOLERANCE = 2e-5


class Inputs(NamedTuple):
    """Tokens, the validity of instances, and the gradient of the lanes' result."""

    lanes: Tokens
    traffic: Tokens
    valid: Array
    gradient: Tokens


def make_inputs(batch: int, lanes: int) -> Inputs:
    """Return seeded random inputs; about two thirds of the instances are valid, the first always."""
    rng = np.random.default_rng([batch, lanes])
    lane, traffic, gradient = (
        rng.standard_normal((batch, n, HEADS, CHANNELS), np.float32) for n in (lanes, TRAFFIC, lanes)
    )
    valid = rng.random((batch, TRAFFIC)) < 2 / 3
    valid[:, 0] = True
    return Inputs(jnp.asarray(lane), jnp.asarray(traffic), jnp.asarray(valid), jnp.asarray(gradient))


def ours(query: Tokens, key: Tokens, value: Tokens, mask: Array | None) -> Tokens:
    """Masked attention of this library."""

    def one(query, key, value, mask):
        query, key, value = (x.swapaxes(0, 1) for x in (query, key, value))
        return masked_attention(query, key, value, mask).swapaxes(0, 1)

    return jax.vmap(one)(query, key, value, mask)


def jax_nn(query: Tokens, key: Tokens, value: Tokens, mask: Array | None) -> Tokens:
    """`jax.nn.dot_product_attention`, whose mask must have its full size."""
    if mask is not None:
        mask = jnp.broadcast_to(mask[:, None], (len(query), 1, query.shape[1], key.shape[1]))
    return jax.nn.dot_product_attention(query, key, value, mask=mask)


def flax_linen(query: Tokens, key: Tokens, value: Tokens, mask: Array | None) -> Tokens:
    """`flax.linen.dot_product_attention`."""
    return nn.dot_product_attention(query, key, value, mask=None if mask is None else mask[:, None])


def additive(query: Tokens, key: Tokens, value: Tokens, mask: Array | None) -> Tokens:
    """Plain einsum and softmax with a large negative number added where masked."""
    bias = 0.0 if mask is None else jnp.where(mask, 0.0, -1e9)[:, None]
    logits = jnp.einsum("bqhd,bkhd->bhqk", query, key) / query.shape[-1] ** 0.5
    return jnp.einsum("bhqk,bkhd->bqhd", jax.nn.softmax(logits + bias, -1), value)


def where(query: Tokens, key: Tokens, value: Tokens, mask: Array | None) -> Tokens:
    """Plain einsum and softmax with the logits replaced where masked."""
    logits = jnp.einsum("bqhd,bkhd->bhqk", query, key) / query.shape[-1] ** 0.5
    if mask is not None:
        logits = jnp.where(mask[:, None], logits, -1e9)
    return jnp.einsum("bhqk,bkhd->bqhd", jax.nn.softmax(logits, -1), value)


def by_quadrant(attend: Attend, result: Result, lanes, traffic, quadrants: dict[str, Any]):
    """Run the fusion modules of `result` in the TFM's order, with residuals; return the lanes."""
    if result == "All":
        traffic = traffic + attend(traffic, traffic, traffic, quadrants["T->T"])
        traffic = traffic + attend(traffic, lanes, lanes, quadrants["T->L"])
    lanes = lanes + attend(lanes, traffic, traffic, quadrants["L->T"])
    return lanes + attend(lanes, lanes, lanes, quadrants["L->L"])


def by_matrix(attend: Attend, result: Result, lanes: Tokens, traffic: Tokens, mask: Array) -> Tokens:
    """Return the same over all L+T tokens at once, each module under M_s with all but its quadrant false."""
    count = lanes.shape[1]
    is_lane = jnp.arange(mask.shape[-1]) < count
    sides = {"T->T": (~is_lane, ~is_lane), "T->L": (~is_lane, is_lane), "L->T": (is_lane, ~is_lane)}
    sides["L->L"] = (is_lane, is_lane)
    tokens = jnp.concatenate([lanes, traffic], 1)
    for rows, columns in [sides[name] for name in (sides if result == "All" else ("L->T", "L->L"))]:
        own = mask & (rows[:, None] & columns[None, :])[None]
        attended = attend(tokens, tokens, tokens, own)
        # Rows without keys hold the mean of masked values.
        tokens = tokens + jnp.where(own.any(-1)[:, :, None, None], attended, 0.0)
    return tokens[:, :count]


def jointly(attend: Attend, lanes: Tokens, traffic: Tokens, mask: Array) -> Tokens:
    """Return the lanes after one attention over all L+T tokens."""
    tokens = jnp.concatenate([lanes, traffic], 1)
    return lanes + attend(tokens, tokens, tokens, mask)[:, : lanes.shape[1]]


def lanes_jointly(lanes: Tokens, traffic: Tokens, mask: Array) -> Tokens:
    """Return the same from the rows of M_s that anyone reads."""
    tokens = jnp.concatenate([lanes, traffic], 1)
    return lanes + ours(lanes, tokens, tokens, mask[:, : lanes.shape[1]])


def spatial_masks(inputs: Inputs) -> SpatialMask:
    """Return M_s of every example; the host has no mask of its own."""
    count = inputs.lanes.shape[1]
    return jax.vmap(lambda valid: SpatialMask.from_validity(count, valid))(inputs.valid)


def quadrants_of(mask: SpatialMask) -> dict[str, Array | None]:
    """Return the quadrants by fusion module."""
    return {
        "T->T": mask.traffic_traffic,
        "T->L": mask.traffic_lane,
        "L->T": mask.lane_traffic,
        "L->L": mask.lane_lane,
    }


def variants(result: Result, lanes: int) -> dict[str, Callable[[Inputs], Tokens]]:
    """Return the programs that compute `result`, by name; `OURS` first."""

    def quadrant(attend):
        return lambda x: by_quadrant(attend, result, x.lanes, x.traffic, quadrants_of(spatial_masks(x)))

    def matrix(attend):
        return lambda x: by_matrix(attend, result, x.lanes, x.traffic, jax.vmap(SpatialMask.dense)(spatial_masks(x)))

    def joint(attend):
        return lambda x: jointly(attend, x.lanes, x.traffic, jax.vmap(SpatialMask.dense)(spatial_masks(x)))

    if result == "joint":
        return {
            OURS: lambda x: lanes_jointly(x.lanes, x.traffic, jax.vmap(SpatialMask.dense)(spatial_masks(x))),
            "ours, all rows": joint(ours),
            "jax.nn": joint(jax_nn),
            "flax.linen": joint(flax_linen),
            "dense additive": joint(additive),
            "dense where": joint(where),
        }
    narrow = {
        OURS: quadrant(ours),
        "jax.nn, quadrants": quadrant(jax_nn),
        "flax.linen, quadrants": quadrant(flax_linen),
        "where, quadrants": quadrant(where),
    }
    if lanes > LARGEST_DENSE:
        return narrow
    return narrow | {
        "dense ours": matrix(ours),
        "dense additive": matrix(additive),
        "dense where": matrix(where),
        "dense jax.nn": matrix(jax_nn),
    }


def with_gradient(function: Callable[[Inputs], Tokens]) -> Callable[[Inputs], tuple]:
    """Return the function's value with the gradients of lanes and traffic."""

    def run(inputs: Inputs):
        out, pull = jax.vjp(lambda a, b: function(inputs._replace(lanes=a, traffic=b)), inputs.lanes, inputs.traffic)
        return out, *pull(inputs.gradient)

    return run


def torch_programs(result: Result, inputs: Inputs) -> dict[str, Compiled]:
    """Return PyTorch's `scaled_dot_product_attention`, forward and with gradient; nothing where torch is missing."""
    try:
        torch = import_torch()
    except UserError:
        return {}
    lanes, traffic, gradient = (torch.tensor(np.asarray(x)) for x in (inputs.lanes, inputs.traffic, inputs.gradient))
    mask = spatial_masks(inputs)
    quadrants = {k: None if m is None else torch.tensor(np.asarray(m)) for k, m in quadrants_of(mask).items()}
    whole = torch.tensor(np.asarray(jax.vmap(SpatialMask.dense)(mask))) if result == "joint" else None

    def attend(query, key, value, mask):
        heads_first = (x.transpose(1, 2) for x in (query, key, value))
        attention = torch.nn.functional.scaled_dot_product_attention
        return attention(*heads_first, attn_mask=None if mask is None else mask[:, None]).transpose(1, 2)

    def function(lanes, traffic):
        if result == "joint":
            tokens = torch.cat([lanes, traffic], 1)
            return lanes + attend(tokens, tokens, tokens, whole)[:, : lanes.shape[1]]
        return by_quadrant(attend, result, lanes, traffic, quadrants)

    def forward():
        with torch.no_grad():
            return function(lanes, traffic)

    def gradients():
        leaves = [x.detach().requires_grad_() for x in (lanes, traffic)]
        out = function(*leaves)
        return out.detach(), *torch.autograd.grad(out, leaves, gradient)

    return {"forward": Compiled(forward, 0.0), "gradient": Compiled(gradients, 0.0)}


def check_equal(name: str, got: Any, expected: Any) -> float:
    """Return the largest difference relative to 1 + the largest value; raise AssertionError above `TOLERANCE`."""
    error = 0.0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        error = max(error, float(np.abs(a - b).max() / (1.0 + np.abs(b).max())))
    assert error <= TOLERANCE, f"{name} differs by {error:.1e}"
    return error


def compare(result: Result, batch: int, lanes: int, seconds: float) -> list[dict[str, Any]]:
    """Check and time all variants of one result at one size; return one record for forward and one for gradient."""
    inputs = make_inputs(batch, lanes)
    torch = torch_programs(result, inputs)
    records = []
    for mode in ("forward", "gradient"):
        functions = variants(result, lanes)
        if mode == "gradient":
            functions = {name: with_gradient(function) for name, function in functions.items()}
        compiled = {name: compile_jax(function, inputs) for name, function in functions.items()}
        if torch:
            compiled["torch"] = torch[mode]
        expected = compiled[OURS].program()
        errors = {name: check_equal(name, c.program(), expected) for name, c in compiled.items()}
        programs = {name: c.program for name, c in compiled.items() if name != "torch"}
        timings = summarise(interleave(programs, seconds), OURS)
        if torch:
            # Apart, against ours alone: its threads would disturb whichever program came next.
            pair = {name: compiled[name].program for name in (OURS, "torch")}
            timings["torch"] = summarise(interleave(pair, seconds), OURS)["torch"]
        for name, timing in timings.items():
            timing |= {"compile_s": compiled[name].seconds, "error": errors[name]}
        records.append({"result": result, "batch": batch, "lanes": lanes, "mode": mode, "variants": timings})
    return records


def table(records: list[dict[str, Any]]) -> str:
    """Return one table per result: median milliseconds of ours, and of the others the ratio to it."""
    parts = []
    for result in dict.fromkeys(record["result"] for record in records):
        own = [record for record in records if record["result"] == result]
        names = list(dict.fromkeys(name for record in own for name in record["variants"]))
        header = [result, *(f"L={r['lanes']} B={r['batch']} {r['mode'][:4]}" for r in own)]
        rows = []
        for name in names:
            cells = [record["variants"].get(name) for record in own]
            show = "{median_ms:.2f} ms" if name == OURS else "{ratio:.2f}"
            rows.append([name, *("-" if cell is None else show.format(**cell) for cell in cells)])
        parts.append(markdown_table(header, rows))
    return "\n\n".join(parts)


def run(
    out: Path, *, lanes: tuple[int, ...] = LANES, results: tuple[Result, ...] = RESULTS, seconds: float = 5.0
) -> dict[str, Any]:
    """Run the benchmark, print its table and write `attention_masks.json` and `.md` into `out`; return the record.

    Args:
        out: folder.
        lanes: lane tokens L; batch 1, and 8 up to `LARGEST_DENSE`.
        results: which results to compare.
        seconds: at least that long for each comparison.
    """
    record: dict[str, Any] = {"traffic": TRAFFIC, "heads": HEADS, "channels": CHANNELS, "torch": _torch()}
    record["records"] = []
    for result in results:
        for count in lanes:
            for batch in (1, 8) if count <= LARGEST_DENSE else (1,):
                record["records"] += compare(result, batch, count, seconds)
    record = machine() | record  # the load is that at the end
    text = table(record["records"])
    print(text)
    save(out, "attention_masks", record, text)
    return record


def _torch() -> dict[str, Any] | str:
    try:
        torch = import_torch()
    except UserError:
        return "not installed, left out"
    return {"version": torch.__version__, "threads": cores()}


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=5.0)
    parser.add_argument("--lanes", type=int, nargs="+", default=LANES, help="numbers of lane tokens")
    parser.add_argument("--results", nargs="+", default=RESULTS, choices=RESULTS, help="what to compute")
    options = parser.parse_args()
    run(options.out, lanes=tuple(options.lanes), results=tuple(options.results), seconds=options.seconds)


if __name__ == "__main__":
    main()
