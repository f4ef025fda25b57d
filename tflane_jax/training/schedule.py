"""AdamW with linear warm-up, cosine decay and gradient clipping; the defaults are TopoNet's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import optax

from tflane_jax.errors import UserError
from tflane_jax.training.task import Params


@dataclass(frozen=True)
class OptimConfig:
    """Optimiser and averaging.

    Attributes:
        lr: peak learning rate.
        warmup_steps: steps of linear rise from `warmup_ratio * lr` to `lr`.
        warmup_ratio, final_ratio: first and last learning rate relative to `lr`.
        weight_decay: decoupled, on kernels and embeddings only.
        clip_norm: largest global gradient norm.
        b1, b2, eps: of Adam.
        ema_decay: of the averaged parameters that are evaluated; 0 evaluates the parameters themselves.
    """

    lr: float = 2e-4
    warmup_steps: int = 500
    warmup_ratio: float = 1 / 3
    final_ratio: float = 1e-3
    weight_decay: float = 0.01
    clip_norm: float = 35.0
    b1: float = 0.9
    b2: float = 0.999
    eps: float = 1e-8
    ema_decay: float = 0.999


def make_schedule(config: OptimConfig, steps: int) -> optax.Schedule:
    """Return the learning rate as a function of the step (0 is the first update).

    Raises UserError where the warm-up does not end before the training does.
    """
    if not 0 <= config.warmup_steps < steps:
        raise UserError(
            f"optim.warmup_steps is {config.warmup_steps} but there are only {steps} steps: "
            "lower optim.warmup_steps or raise training.steps"
        )
    return optax.warmup_cosine_decay_schedule(
        init_value=config.lr * config.warmup_ratio,
        peak_value=config.lr,
        warmup_steps=config.warmup_steps,
        decay_steps=steps,
        end_value=config.lr * config.final_ratio,
    )


def make_optimizer(config: OptimConfig, steps: int) -> optax.GradientTransformation:
    """Return the gradient transformation of a run of `steps` updates."""
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.adamw(
            make_schedule(config, steps), b1=config.b1, b2=config.b2, eps=config.eps,
            weight_decay=config.weight_decay, mask=is_decayed,
        ),
    )  # fmt: skip


def is_decayed(params: Params) -> Any:
    """Return which leaves weight decay acts on: matrices, but neither biases nor the scales of norms.

    Names count beside ranks because the biases of attention heads are matrices too.
    """

    def decayed(path: tuple[Any, ...], leaf: jax.Array) -> bool:
        return leaf.ndim > 1 and getattr(path[-1], "key", None) not in ("bias", "scale")

    return jax.tree_util.tree_map_with_path(decayed, params)
