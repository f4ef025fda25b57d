"""Bipartite (Hungarian) matching of queries to targets.

Two backends give the same assignments, as long as costs have no ties and none is so large that float32 loses the
differences of other pairs: near the limit of 1e6, or a large negative cost in the chosen assignment. "jax" runs on
the device, in a program that JAX can keep between processes (persistent compilation cache), and takes as long as scipy
at the sizes of small models. "scipy" runs on the host: one call per step for every layer and example, because the
callback receives `vmap`ped axes as batch axes and loops over them. A program with a host callback can be neither
exported nor kept, so do not use it in prediction.

Where a batch is divided among devices, each device (or its host) solves the problems of its own examples. "scipy" is
refused where these devices are parts of one CPU: its callbacks occupy the threads that copy their arguments, and can
hang.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.devices import DATA_AXIS
from tflane_jax.errors import UserError

Backend = Literal["scipy", "jax"]

_COST_LIMIT = 1e6


@struct.dataclass
class Assignment:
    """The query matched with each target.

    Attributes:
        query: (N,) query index of each target; 0 for unmatched targets.
        matched: (N,) the target is valid and has a query. With more targets than queries, some are unmatched.
    """

    query: Int[Array, "*b n"]
    matched: Bool[Array, "*b n"]


def match(cost: Float[Array, "*b q n"], valid: Bool[Array, "*#b n"], backend: Backend = "jax") -> Assignment:
    """Return the assignment of minimum total cost between queries and valid targets; no gradient flows.

    Args:
        cost: cost of matching query q with target n; ignored for invalid targets. Costs are clipped to +-1e6 and NaN
            counts as 1e6, so that a diverging model fails at the loss and not here.
        valid: False for padding; its leading axes broadcast against those of the costs.
        backend: "scipy" runs on the host, "jax" on the device.

    Raises ValueError for another backend, UserError for "scipy" on several devices of one CPU.
    """
    if backend not in get_args(Backend):
        raise ValueError(f"backend is {backend!r}: it must be {' or '.join(map(repr, get_args(Backend)))}")
    cost = lax.stop_gradient(cost).astype(jnp.float32)
    cost = jnp.nan_to_num(jnp.clip(cost, -_COST_LIMIT, _COST_LIMIT), nan=_COST_LIMIT)
    valid = jnp.broadcast_to(valid, (*cost.shape[:-2], cost.shape[-1]))
    if 0 in cost.shape:
        return Assignment(jnp.zeros(valid.shape, jnp.int32), jnp.zeros(valid.shape, bool))
    query = _by_device(_on_device if backend == "jax" else _on_host, cost, valid)
    matched = query >= 0
    return Assignment(jnp.where(matched, query, 0), matched)


def _by_device(solve: Callable[[Any, Any], Any], cost: Float[Array, "*b q n"], valid: Bool[Array, "*b n"]) -> Any:
    """Solve all problems, those of each device's examples there.

    Left to itself, XLA would run the loops of all devices in step, with an exchange in every round.
    """
    devices = jax.sharding.get_abstract_mesh().shape.get(DATA_AXIS, 1)
    if devices > 1 and solve is _on_host and jax.default_backend() == "cpu":
        raise UserError("matcher 'scipy' can hang on several devices of one CPU: choose 'jax', or one device")
    if devices == 1 or cost.ndim == 2 or cost.shape[0] % devices:
        return solve(cost, valid)
    examples = jax.sharding.PartitionSpec(DATA_AXIS)
    # Loops begin with constants, which are equal on all devices, and go on with values that are not: not for `vma`.
    return jax.shard_map(solve, in_specs=(examples, examples), out_specs=examples, check_vma=False)(cost, valid)


def _on_device(cost: Float[Array, "*b q n"], valid: Bool[Array, "*b n"]) -> Int[Array, "*b n"]:
    solve = _augmenting_paths
    for _ in cost.shape[:-2]:
        solve = jax.vmap(solve)
    return solve(cost, valid)


def _on_host(cost: Float[Array, "*b q n"], valid: Bool[Array, "*b n"]) -> Int[Array, "*b n"]:
    shape = jax.ShapeDtypeStruct(valid.shape, np.int32)
    return jax.pure_callback(_assign_on_host, shape, cost, valid, vmap_method="expand_dims")


def _assign_on_host(cost: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Solve every problem of the leading axes with scipy; -1 for a target without a query.

    Module-level and numpy-only: jax may call it from any thread.
    """
    from scipy.optimize import linear_sum_assignment

    cost, valid = np.asarray(cost), np.asarray(valid)
    lead = np.broadcast_shapes(cost.shape[:-2], valid.shape[:-1])
    cost = np.broadcast_to(cost, (*lead, *cost.shape[-2:])).reshape(-1, *cost.shape[-2:])
    valid = np.broadcast_to(valid, (*lead, valid.shape[-1])).reshape(-1, valid.shape[-1])
    query = np.full(valid.shape, -1, np.int32)
    for problem, exists, solution in zip(cost, valid, query, strict=True):
        columns = np.flatnonzero(exists)
        targets, queries = linear_sum_assignment(problem[:, columns].T)
        solution[columns[targets]] = queries
    return query.reshape(*lead, -1)


class _Search(NamedTuple):
    """Shortest paths from one target to the C columns, as far as they are known.

    Attributes:
        distance: (C,) length of the shortest path found to each column.
        via: (C,) target from which that path reaches the column; -1 for none.
        done: (C,) columns whose distance is final.
        row: target that the search goes on from, the holder of the last final column; -1: that column is free.
        length: distance of the last final column.
        column: the last final column.
    """

    distance: Float[Array, " c"]
    via: Int[Array, " c"]
    done: Bool[Array, " c"]
    row: Int[Array, ""]
    length: Float[Array, ""]
    column: Int[Array, ""]


def _augmenting_paths(cost: Float[Array, "q n"], valid: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Solve one problem by successive shortest augmenting paths (Jonker-Volgenant); -1 for targets without a query.

    One path per valid target, so padding takes no time. If there are more targets than queries, spare columns mean "no
    query"; they cost more than any query.
    """
    queries, targets = cost.shape
    spare = max(targets - queries, 0)
    spare_cost = 2.0 * (jnp.max(jnp.where(valid[None], jnp.abs(cost), 0.0)) + 1.0)
    table = jnp.concatenate([cost, jnp.full((spare, targets), spare_cost, jnp.float32)]).T  # (targets, columns)
    columns = queries + spare
    order = jnp.argsort(~valid, stable=True).astype(jnp.int32)  # valid targets first

    def add_target(i, state):
        owner, u, v = state  # owner (columns,): target that holds the column, -1 if free

        def grow(search: _Search) -> _Search:
            slack = table[search.row] - u[search.row] - v + search.length
            closer = ~search.done & (slack < search.distance)
            distance = jnp.where(closer, slack, search.distance)
            via = jnp.where(closer, search.row, search.via)
            column = lax.argmin(jnp.where(search.done, jnp.inf, distance), 0, jnp.int32)
            return _Search(distance, via, search.done.at[column].set(True), owner[column], distance[column], column)

        start = order[i]
        search = _Search(
            distance=jnp.full(columns, jnp.inf, jnp.float32),
            via=jnp.full(columns, -1, jnp.int32),
            done=jnp.zeros(columns, bool),
            row=start,
            length=jnp.float32(0.0),
            column=jnp.int32(0),
        )
        search = lax.while_loop(lambda search: search.row >= 0, grow, search)

        # Potentials inside the tree change by the rest of the shortest path.
        gain = jnp.where(search.done, search.length - search.distance, 0.0)
        holders = jnp.where(search.done & (owner >= 0), owner, targets)  # index `targets` is dropped
        u = u.at[holders].add(gain, mode="drop").at[start].add(search.length)
        v = v - gain

        def flip(step):
            """Give a column to the target that reached it; go on with the column that this target held before."""
            owner, column, _ = step
            row = search.via[column]
            previous = lax.argmax(owner == row, 0, jnp.int32)
            return owner.at[column].set(row), previous, row

        def is_away_from_start(step):
            _, _, row = step
            return row != start

        owner, _, _ = lax.while_loop(is_away_from_start, flip, flip((owner, search.column, start)))
        return owner, u, v

    state = (jnp.full(columns, -1, jnp.int32), jnp.zeros(targets, jnp.float32), jnp.zeros(columns, jnp.float32))
    owner, _, _ = lax.fori_loop(0, valid.sum(), add_target, state)
    held = jnp.where(owner[:queries] >= 0, owner[:queries], targets)
    return jnp.full(targets, -1, jnp.int32).at[held].set(jnp.arange(queries, dtype=jnp.int32), mode="drop")
