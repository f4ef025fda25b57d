"""Adam (or Muon) with linear warm-up, cosine decay and gradient clipping; the defaults are TopoNet's.

The cosine goes down once over the run, by step or by epoch, or in cycles with warm restarts (`training.restarts`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.models.parameters import Params
from tflane_jax.training.muon import scale_by_muon
from tflane_jax.training.restarts import (
    Cycle,
    RestartsConfig,
    check_restarts,
    current_cycle,
    cycle_of,
    first_cycle,
    half_cosine,
    relative_rate,
)


@dataclass(frozen=True)
class OptimConfig:
    """Optimiser and averaging.

    Attributes:
        lr: peak learning rate.
        warmup_steps: steps of linear rise from `warmup_ratio * lr` to `lr`.
        warmup_ratio, final_ratio: first and last learning rate relative to `lr` (with restarts the last one is theirs).
        weight_decay: on kernels and embeddings only.
        decay: "decoupled" from the gradient (AdamW), or "coupled": added to it, after clipping (PyTorch's Adam).
        optimizer: of the kernels that `muon_kernels` names; all other parameters have Adam. "muon" (Jordan et al.
            2024) orthogonalises the updates. None of the three papers uses it; docs/cameras.md has its effect on
            small models.
        muon_kernels: which kernels are Muon's; that of a convolution is a matrix of (kh kw cin) x cout.
        clip_norm: largest global gradient norm; inf for none.
        b1, b2, eps: of Adam.
        ema_decay: of the averaged parameters that are evaluated; 0 evaluates the parameters themselves.
        epoch_steps: 0 lowers the learning rate with every step from the end of the warm-up to the end of the run.
            A positive number is the length of an epoch: as in mmcv's cosine annealing by epoch, the rate is constant
            within an epoch, the cosine spans all epochs, and the warm-up multiplies it.
        restarts: cycles of the learning rate that follow the warm-up; None has one cosine over the run.
    """

    lr: float = 2e-4
    warmup_steps: int = 500
    warmup_ratio: float = 1 / 3
    final_ratio: float = 1e-3
    weight_decay: float = 0.01
    decay: Literal["decoupled", "coupled"] = "decoupled"
    optimizer: Literal["adam", "muon"] = "adam"
    muon_kernels: Literal["dense", "dense_and_convolution"] = "dense"
    clip_norm: float = 35.0
    b1: float = 0.9
    b2: float = 0.999
    eps: float = 1e-8
    ema_decay: float = 0.999
    epoch_steps: int = 0
    restarts: RestartsConfig | None = None


Rate = Callable[[Any, Int[ArrayLike, ""]], Float[Array, ""]]
"""(the optimiser's state, the number of updates made) -> learning rate of the next update."""


def make_rate(config: OptimConfig, steps: int) -> Rate:
    """Return the function that gives the learning rate of the next update; raises like `make_optimizer`."""
    _check(config, steps)
    if (restarts := config.restarts) is None:
        schedule = make_schedule(config, steps)
        return lambda opt_state, step: jnp.asarray(schedule(step))
    return lambda opt_state, step: _cycle_rate(config, restarts, current_cycle(restarts, cycle_of(opt_state), steps))


def make_schedule(config: OptimConfig, steps: int) -> optax.Schedule:
    """Return the learning rate as a function of the step (0 is the first update), for a run without restarts.

    Raises:
        UserError: the warm-up does not end before the training does, or `epoch_steps` is negative.
        ValueError: the configuration has restarts; see `make_rate`.
    """
    _check(config, steps)
    if config.restarts is not None:
        raise ValueError("with restarts the learning rate depends on the optimiser's state, not on the step alone")
    if config.epoch_steps:
        epochs = -(-steps // config.epoch_steps)

        def by_epoch(step: Int[ArrayLike, "..."]) -> Float[Array, "..."]:
            epoch = jnp.minimum(jnp.asarray(step) // config.epoch_steps, epochs)
            decay = config.final_ratio + (1.0 - config.final_ratio) * half_cosine(epoch, epochs)
            return config.lr * warmup_factor(config, step) * decay

        return by_epoch
    return optax.warmup_cosine_decay_schedule(
        init_value=config.lr * config.warmup_ratio,
        peak_value=config.lr,
        warmup_steps=config.warmup_steps,
        decay_steps=steps,
        end_value=config.lr * config.final_ratio,
    )


def warmup_factor(config: OptimConfig, step: Int[ArrayLike, "..."]) -> Float[Array, "..."]:
    """Return the factor of the warm-up: from `warmup_ratio` to 1, then 1."""
    missing = jnp.maximum(1.0 - jnp.asarray(step) / max(config.warmup_steps, 1), 0.0)
    return 1.0 - (1.0 - config.warmup_ratio) * (missing if config.warmup_steps else jnp.zeros_like(missing))


def make_optimizer(config: OptimConfig, steps: int) -> optax.GradientTransformation:
    """Return the gradient transformation of a run of `steps` updates.

    Raises UserError where a setting cannot work, see `make_schedule` and `RestartsConfig`.
    """
    _check(config, steps)
    decay = optax.masked(_decay_what_learns(config.weight_decay), is_decayed)
    adam = _preconditioner(config)
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.chain(*((adam, decay) if config.decay == "decoupled" else (decay, adam)), _scale_by_rate(config, steps)),
    )


def _decay_what_learns(rate: float) -> optax.GradientTransformation:
    """Add `rate` times the parameters, except to those whose update is zero everywhere.

    These are the frozen parts of a backbone, which PyTorch does not pass to the optimiser at all.
    """

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        def decayed(change: jax.Array, leaf: jax.Array) -> jax.Array:
            return change + jnp.where(jnp.any(change != 0), rate, 0.0).astype(leaf.dtype) * leaf

        return jax.tree.map(decayed, updates, params), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def _preconditioner(config: OptimConfig) -> optax.GradientTransformation:
    """Return Adam, or Muon for kernels beside Adam for the rest."""
    adam = optax.scale_by_adam(b1=config.b1, b2=config.b2, eps=config.eps)
    if config.optimizer == "adam":
        return adam

    ranks = (2,) if config.muon_kernels == "dense" else (2, 4)

    def labels(params: Params) -> Any:
        def label(path: tuple[Any, ...], leaf: jax.Array) -> str:
            return "muon" if leaf.ndim in ranks and getattr(path[-1], "key", None) == "kernel" else "adam"

        return jax.tree_util.tree_map_with_path(label, params)

    return optax.partition({"adam": adam, "muon": scale_by_muon()}, labels)


def _scale_by_rate(config: OptimConfig, steps: int) -> optax.GradientTransformation:
    """Multiply by the negative learning rate; the state is optax's count of updates, or the cycle."""
    if (restarts := config.restarts) is None:
        return optax.scale_by_learning_rate(make_schedule(config, steps))

    def init(params: Params) -> Cycle:
        return first_cycle(restarts, config.warmup_steps, steps)

    def update(updates: Any, state: Cycle, params: Any = None) -> tuple[Any, Cycle]:
        cycle = current_cycle(restarts, state, steps)
        rate = _cycle_rate(config, restarts, cycle)
        updates = jax.tree.map(lambda leaf: -rate.astype(leaf.dtype) * leaf, updates)
        return updates, cycle._replace(count=cycle.count + 1)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def _cycle_rate(config: OptimConfig, restarts: RestartsConfig, cycle: Cycle) -> Float[Array, ""]:
    return config.lr * warmup_factor(config, cycle.count) * relative_rate(restarts, cycle)


def _check(config: OptimConfig, steps: int) -> None:
    if not 0 <= config.warmup_steps < steps:
        raise UserError(
            f"optim.warmup_steps is {config.warmup_steps} but there are only {steps} steps: "
            "lower optim.warmup_steps or raise training.steps"
        )
    if config.epoch_steps < 0:
        raise UserError(f"optim.epoch_steps is {config.epoch_steps}: it must be at least 0")
    if config.restarts is not None:
        if config.epoch_steps:
            raise UserError("optim.epoch_steps and optim.restarts exclude each other: set epoch_steps to 0")
        check_restarts(config.restarts)


def is_decayed(params: Params) -> Any:
    """Return which leaves get weight decay: matrices, but neither biases nor the scales of norms.

    Names are checked beside ranks, because the biases of attention heads are matrices too.
    """

    def decayed(path: tuple[Any, ...], leaf: jax.Array) -> bool:
        return leaf.ndim > 1 and getattr(path[-1], "key", None) not in ("bias", "scale")

    return jax.tree_util.tree_map_with_path(decayed, params)
