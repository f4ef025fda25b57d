"""Adam (or Muon) with linear warm-up, cosine decay and gradient clipping; the defaults are TopoNet's.

The cosine goes down once over the run, by step or by epoch, or in cycles with warm restarts (`training.restarts`). Or
the rate is constant and drops at given steps. The rate may grow with the batch, and differ between parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Float, Int

from tflane_jax.limits import (
    INCREASING,
    NOT_EMPTY,
    Count,
    CountOrZero,
    Factor,
    Fraction,
    FractionBelowOne,
    Positive,
    PositiveOrInfinite,
    PositiveOrZero,
    Rules,
    SettingError,
    check_settings,
)
from tflane_jax.training.muon import identity, scale_by_muon
from tflane_jax.training.rate_factors import Factors, scale_by_factors
from tflane_jax.training.restarts import (
    Cycle,
    RestartsConfig,
    current_cycle,
    cycle_of,
    first_cycle,
    half_cosine,
    relative_rate,
)
from tflane_jax.training.vectors import Vectors, any_in_leaf, norm


@dataclass(frozen=True)
class DropsConfig:
    """A constant learning rate that drops at given steps, as LSTR's.

    Attributes:
        steps: numbers of updates after which the rate drops, ascending.
        factor: factor on the rate at each drop.
    """

    steps: Annotated[tuple[Count, ...], NOT_EMPTY, INCREASING] = (450_000,)
    factor: Factor = 0.1


@dataclass(frozen=True)
class OptimConfig:
    """Optimizer and averaging.

    Attributes:
        lr: peak learning rate; of a batch of `reference_batch` examples if `lr_scaling` is not "none". 0 changes
            nothing but running statistics and averages.
        lr_scaling: how `lr` changes with the batch size B of the run (of all devices, see `scaled_to_batch`): "none";
            "linear", times B / reference_batch (Goyal et al. 2017, for SGD); "sqrt", times the square root of it, often
            used with Adam.
        reference_batch: examples of an update that `lr` was chosen for. None, where `lr_scaling` is set by an override
            (`--optim.lr-scaling`) or in a configuration file: those that the file, or the ablation named in it, has as
            `training.batch_size`.
        lr_factors: (pattern, factor) pairs. The parameters of a module whose path matches the pattern, for example
            `encoder/images/backbone`, learn at `factor` times the rate, their weight decay included; `*` stands for any
            text, the first pattern that matches decides, and 0 keeps parameters as they are. Every pattern must match.
        warmup_steps: steps of linear rise from `warmup_ratio * lr` to `lr`.
        warmup_ratio: first learning rate relative to `lr`.
        final_ratio: learning rate, relative to `lr`, that the cosine reaches at the end of the run, after the last
            update; `restarts` have their own, `drops` have none.
        weight_decay: weight decay of the parameters that `decayed` names.
        decayed: "kernels" and embeddings, or "all", biases and norms too, as the published camera hosts train.
        decay: "decoupled" from the gradient (AdamW), or "coupled": added to it, after clipping (PyTorch's Adam,
            except that a parameter whose gradient is zero everywhere in an update does not decay in it).
        optimizer: of the kernels that `muon_kernels` names; all other parameters have Adam. "muon" (Jordan et al.
            2024) orthogonalises the updates. None of the three papers uses it; docs/cameras.md has its effect on
            small models.
        muon_kernels: which kernels are Muon's; that of a convolution is a matrix of (kh kw cin) x cout.
        clip_norm: largest global gradient norm; inf for none.
        b1, b2, eps: Adam's parameters.
        ema_decay: of the averaged parameters that are evaluated; 0 evaluates the parameters themselves.
        epoch_steps: 0 lowers the learning rate with every step from the end of the warm-up to the end of the run.
            A positive number is the length of an epoch: as in mmcv's cosine annealing by epoch, the rate is constant
            within an epoch, the cosine spans all epochs, and the warm-up multiplies it.
        restarts: cycles of the learning rate that follow the warm-up; None has one cosine over the run.
        drops: steps at which a constant rate drops, in place of the cosine; None for none.
    """

    lr: PositiveOrZero = 2e-4
    lr_scaling: Literal["none", "linear", "sqrt"] = "none"
    reference_batch: Count | None = None
    lr_factors: Factors = ()
    warmup_steps: CountOrZero = 500
    warmup_ratio: Fraction = 1 / 3
    final_ratio: Fraction = 1e-3
    weight_decay: PositiveOrZero = 0.01
    decayed: Literal["kernels", "all"] = "kernels"
    decay: Literal["decoupled", "coupled"] = "decoupled"
    optimizer: Literal["adam", "muon"] = "adam"
    muon_kernels: Literal["dense", "dense_and_convolution"] = "dense"
    clip_norm: PositiveOrInfinite = 35.0
    b1: FractionBelowOne = 0.9
    b2: FractionBelowOne = 0.999
    eps: Positive = 1e-8
    ema_decay: FractionBelowOne = 0.999
    epoch_steps: CountOrZero = 0
    restarts: RestartsConfig | None = None
    drops: DropsConfig | None = None

    def limits(self) -> Rules:
        """Only one rule lowers the learning rate, and a scaled one has a reference batch."""
        known = self.lr_scaling == "none" or self.reference_batch is not None
        yield "reference_batch", known, f"the batch size that optim.lr is for, with lr_scaling {self.lr_scaling!r}"
        alone = not self.epoch_steps or self.restarts is None
        yield "epoch_steps", alone, "0 with restarts: optim.epoch_steps and optim.restarts exclude each other"
        for name, value in (("restarts", self.restarts), ("epoch_steps", self.epoch_steps)):
            alone = self.drops is None or not value
            yield "drops", alone, f"None with {name}: optim.drops and optim.{name} exclude each other"


Rate = Callable[[Any, Int[ArrayLike, ""]], Float[Array, ""]]
"""(the optimizer's state, the number of updates made) -> learning rate of the next update."""


def scaled_to_batch(config: OptimConfig, batch_size: int) -> OptimConfig:
    """Return the settings with the learning rate of a batch of `batch_size` examples, and `lr_scaling` "none"."""
    check_settings(config, "optim.")
    if config.lr_scaling == "none" or config.reference_batch is None:
        return config
    ratio = batch_size / config.reference_batch
    factor = ratio if config.lr_scaling == "linear" else math.sqrt(ratio)
    return replace(config, lr=config.lr * factor, lr_scaling="none")


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
        UserError: the warm-up does not end before the training does, `epoch_steps` is negative, or `drops`
            cannot be followed.
        ValueError: the configuration has restarts; see `make_rate`.
    """
    _check(config, steps)
    if config.restarts is not None:
        raise ValueError("with restarts the learning rate depends on the optimizer's state, not on the step alone")
    if (drops := config.drops) is not None:

        def by_drops(step: Int[ArrayLike, "..."]) -> Float[Array, "..."]:
            made = sum((jnp.asarray(step) >= drop for drop in drops.steps), jnp.zeros(()))
            return config.lr * warmup_factor(config, step) * drops.factor**made

        return by_drops
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


def schedule_notices(config: OptimConfig, steps: int) -> list[str]:
    """Return notices of changes of the learning rate that a run of `steps` updates never reaches."""
    notices = []
    if config.epoch_steps >= steps:
        notices.append(f"optim.epoch_steps: the run ends at step {steps}, before an epoch lowers the learning rate")
    if config.drops is not None and (late := [drop for drop in config.drops.steps if drop >= steps]):
        notices.append(f"optim.drops.steps: the run ends at step {steps}, before the learning rate drops at {late[0]}")
    if config.restarts is not None:
        first = first_cycle(config.restarts, config.warmup_steps, steps)
        if config.warmup_steps + int(first.length) >= steps:
            notices.append(f"optim.restarts: the run ends at step {steps}, before the learning rate restarts")
    return notices


def warmup_factor(config: OptimConfig, step: Int[ArrayLike, "..."]) -> Float[Array, "..."]:
    """Return the factor of the warm-up: from `warmup_ratio` to 1, then 1."""
    missing = jnp.maximum(1.0 - jnp.asarray(step) / max(config.warmup_steps, 1), 0.0)
    return 1.0 - (1.0 - config.warmup_ratio) * (missing if config.warmup_steps else jnp.zeros_like(missing))


def make_optimizer(
    config: OptimConfig, steps: int, *, gather: Callable[[Vectors], Vectors] = identity
) -> optax.GradientTransformation:
    """Return the gradient transformation of a run of `steps` updates, for `Vectors`.

    Its `init` raises UserError for `lr_factors` that match nothing.

    Args:
        config, steps: of the run.
        gather: see `scale_by_muon`.

    Raises:
        UserError: a setting cannot work, see `make_schedule` and `RestartsConfig`.
        ValueError: the learning rate is not yet that of the batch, see `scaled_to_batch`.
    """
    _check(config, steps)
    decay = _decay_trained_leaves(config.weight_decay)
    if config.decayed == "kernels":
        decay = optax.masked(decay, is_decayed)
    preconditioner = _preconditioner(config, gather)
    ordered = (preconditioner, decay) if config.decay == "decoupled" else (decay, preconditioner)
    factors = (scale_by_factors(config.lr_factors),) if config.lr_factors else ()
    # A chain in a chain, because checkpoints name the parts of the state by their places.
    return optax.chain(_clip_by_norm(config.clip_norm), optax.chain(*ordered, _scale_by_rate(config, steps)), *factors)


def _clip_by_norm(largest: float) -> optax.GradientTransformation:
    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        found = norm(updates)
        return jax.tree.map(lambda g: jnp.where(found < largest, g, g / found * largest), updates), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def _decay_trained_leaves(rate: float) -> optax.GradientTransformation:
    """Add `rate` times the parameters, except to leaves whose update is zero everywhere.

    These are the frozen parts of a backbone, which PyTorch does not pass to the optimizer at all.
    """

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        def decayed(group: str, change: Any) -> Any:
            if isinstance(change, optax.MaskedNode):
                return change
            learns = any_in_leaf(change != 0, updates.layout, group)
            return change + jnp.where(learns, rate, 0.0) * params.groups[group]

        return updates.map(decayed), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def _preconditioner(config: OptimConfig, gather: Callable[[Vectors], Vectors]) -> optax.GradientTransformation:
    """Return Adam, or Muon for kernels beside Adam for the rest."""
    adam = optax.scale_by_adam(b1=config.b1, b2=config.b2, eps=config.eps)
    if config.optimizer == "adam":
        return adam
    kernels = ("dense",) if config.muon_kernels == "dense" else ("dense", "convolution")

    def labels(params: Any) -> Any:
        return params.map(lambda group, _: "muon" if group in kernels else "adam")

    return optax.partition({"adam": adam, "muon": scale_by_muon(gather)}, labels)


def _scale_by_rate(config: OptimConfig, steps: int) -> optax.GradientTransformation:
    """Multiply by the negative learning rate; the state is optax's count of updates, or the cycle."""
    if (restarts := config.restarts) is None:
        return optax.scale_by_learning_rate(make_schedule(config, steps))

    def init(params: Any) -> Cycle:
        return first_cycle(restarts, config.warmup_steps, steps)

    def update(updates: Any, state: Cycle, params: Any = None) -> tuple[Any, Cycle]:
        cycle = current_cycle(restarts, state, steps)
        rate = _cycle_rate(config, restarts, cycle)
        updates = jax.tree.map(lambda leaf: -rate.astype(leaf.dtype) * leaf, updates)
        return updates, cycle._replace(count=cycle.count + 1)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def _cycle_rate(config: OptimConfig, restarts: RestartsConfig, cycle: Cycle) -> Float[Array, ""]:
    return config.lr * warmup_factor(config, cycle.count) * relative_rate(restarts, cycle)


def warmup_fits(config: OptimConfig, steps: int) -> tuple[str, bool, str]:
    """Return the rule that the warm-up ends before the run does."""
    allowed = f"less than the steps of the run (training.steps, {steps})"
    return "optim.warmup_steps", config.warmup_steps < steps, allowed


def _check(config: OptimConfig, steps: int) -> None:
    if config.lr_scaling != "none":
        raise ValueError("call scaled_to_batch first: the learning rate depends on the batch size")
    check_settings(config, "optim.")
    setting, fits, allowed = warmup_fits(config, steps)
    if not fits:
        raise SettingError(setting, config.warmup_steps, allowed)


def is_decayed(params: Vectors) -> Vectors:
    """Return which groups get weight decay: matrices, but neither biases nor the scales of norms."""
    return params.map(lambda group, _: group != "plain")
