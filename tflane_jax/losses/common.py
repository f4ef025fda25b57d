"""Common parts of all host losses: interface, counts of matched queries, topology loss."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.matching import Assignment
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.scene import Example, Prediction

NameT = TypeVar("NameT", bound=str)

Terms = dict[str, Float[Array, " layers"]]
"""Weighted loss terms by name, one value for each decoder layer."""
Report = dict[str, Float[Array, ""]]
"""Numbers to record: the last layer's terms, and counts."""
ClassMean = Literal["frame", "batch"]
"""What the class losses are divided by, see `over_matched`."""


@dataclass(frozen=True)
class HostLossConfig:
    """Weights of a host's loss; every host derives its own class, in its own file."""

    abstract_base: ClassVar[bool] = True
    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: Example, host: Any
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record.

        Args:
            outputs: predictions of every decoder layer, leading axes (batch, layer).
            auxiliary: auxiliary outputs, leading axis batch.
            batch: examples with ground truth, leading axis batch.
            host: the host's configuration.

        Raises:
            UserError: the examples lack ground truth for a predicted part.
        """
        raise NotImplementedError


def checked_loss(losses: HostLossConfig, found: Any) -> tuple[Float[Array, ""], Report]:
    """Return what `loss` returned; raise UserError, which names its class, for anything but a scalar and scalars."""
    what = f"{type(losses).__name__}.loss"
    if not isinstance(found, tuple) or len(found) != 2 or not isinstance(found[1], dict):
        raise UserError(f"{what} returned {type(found).__name__}: expected a tuple of the loss and a dict of numbers")
    loss, report = found
    for name, value in {"the loss": loss, **{f"the number {name!r}": value for name, value in report.items()}}.items():
        try:
            shape, kind = jnp.shape(value), jnp.result_type(value)
        except TypeError:
            raise UserError(f"{what}: {name} is {type(value).__name__}, expected a scalar array") from None
        if shape != ():
            raise UserError(f"{what}: {name} has shape {shape}, expected a scalar")
        if value is loss and not jnp.issubdtype(kind, jnp.floating):
            raise UserError(f"{what}: {name} is of type {kind}, expected a float")
    return loss, report


def declared_outputs(outputs: AuxiliaryOutputs, names: Iterable[NameT]) -> Iterator[tuple[NameT, Any]]:
    """Yield name and value of the auxiliary outputs that a host declares, in the order of `names`.

    Raises:
        ValueError: one of them is missing.
    """
    for name in names:
        if (output := getattr(outputs, name)) is None:
            raise ValueError(f"the host declares the auxiliary output {name}, but it is missing: sow it in the model")
        yield name, output


def without_loss(name: str, function: str) -> ValueError:
    """Return the error that a function of losses has none for an auxiliary output."""
    return ValueError(f"the auxiliary output {name} has no loss: add a branch to {function}")


def total(terms: Terms) -> Float[Array, ""]:
    """Return the sum of all terms over all layers."""
    return jnp.stack([term.sum() for term in terms.values()]).sum()


def last_layer(terms: Terms) -> Report:
    """Return the terms of the last layer."""
    return {name: term[-1] for name, term in terms.items()}


def edge_loss(
    logits: Float[Array, "b layers q r"],
    rows: Assignment,
    columns: Assignment,
    edges: Bool[Array, "b n m"],
    alpha: float,
    gamma: float,
) -> Float[Array, " layers"]:
    """Return the mean focal loss over all pairs of queries of a batch, for each layer.

    Pairs with an unmatched query have the target "no edge".

    Args:
        logits: predicted edges.
        rows, columns: assignments of the row queries and of the column queries.
        edges: true edges between targets.
        alpha, gamma: parameters of the focal loss.
    """

    def one(logits, rows, columns, edges):
        row, column = (
            jnp.where(side.matched, side.query, count)
            for side, count in zip((rows, columns), logits.shape, strict=True)
        )
        true = jnp.zeros(logits.shape).at[row[:, None], column[None, :]].set(edges.astype(jnp.float32), mode="drop")
        return focal(logits, true, alpha, gamma).mean() if logits.size else jnp.zeros(())

    return jax.vmap(jax.vmap(one, in_axes=(0, 0, 0, None)))(logits, rows, columns, edges).mean(0)


def matched_edge_sums(
    logits: Float[Array, "b q r"],
    rows: Assignment,
    columns: Assignment,
    edges: Bool[Array, "b n m"],
    loss: tuple[float, float],
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    """Return the sum of the focal loss over pairs of matched queries, and what it is divided by, for each example.

    The divisor is the number of pairs without an edge, as in the published code. Pairs with an unmatched query do not
    count: LaneSegNet's relationship head (docs/reference/lanesegnet.md).

    Args:
        logits: predicted edges of one layer.
        rows, columns: assignments (B, N) and (B, M) of that layer.
        edges: true edges between targets.
        loss: alpha and gamma of the focal loss.
    """

    def one(logits, rows, columns, edges):
        pairs: Bool[Array, "n m"] = rows.matched[:, None] & columns.matched[None]
        edges = edges & pairs
        found = logits[rows.query[:, None], columns.query[None]]
        each = focal(found, edges.astype(logits.dtype), *loss)
        return jnp.where(pairs, each, 0.0).sum(), (pairs & ~edges).sum().astype(jnp.float32)

    return jax.vmap(one)(logits, rows, columns, edges)


def focal(logits: Float[Array, "*b"], target: Float[Array, "*b"], alpha: float, gamma: float) -> Float[Array, "*b"]:
    """Return the sigmoid focal loss (Lin et al. 2017), elementwise."""
    return optax.losses.sigmoid_focal_loss(logits, target, alpha=alpha, gamma=gamma)


def quality_focal(logits: Float[Array, "*b"], target: Float[Array, "*b"], gamma: float) -> Float[Array, "*b"]:
    """Return the quality focal loss |target - p|^gamma * cross entropy (Li et al. 2020, Eq. 2), elementwise.

    Args:
        logits: of the probability p.
        target: quality in [0, 1]; 0 for negatives.
        gamma: exponent, beta in the paper.
    """
    apart = jnp.abs(target - jax.nn.sigmoid(logits))
    if gamma < 1.0:  # A power below 1 has no finite slope at 0, which saturated logits reach.
        apart = jnp.maximum(apart, 1e-6)
    return apart**gamma * optax.losses.sigmoid_binary_cross_entropy(logits, target)


def class_losses(
    logits: Float[Array, "q c"],
    query: Int[Array, " n"],
    category: Int[Array, " n"] | int,
    quality: Float[Array, " n"] | None,
    alpha: float,
    gamma: float,
) -> Float[Array, "q c"]:
    """Return the class loss of every query and class of one example.

    Args:
        logits: of the queries.
        query: of each target; one that lies outside writes nowhere.
        category: class of each target.
        quality: of each target's prediction, the value to predict by `quality_focal`; without, it is 1 by `focal`.
        alpha, gamma: see `focal`.
    """
    target = jnp.zeros(logits.shape)
    if quality is None:
        return focal(logits, target.at[query, category].set(1.0, mode="drop"), alpha, gamma)
    target = target.at[query, category].set(lax.stop_gradient(quality), mode="drop")
    return quality_focal(logits, target, gamma)


def last_layers(assignment: Assignment, layers: int) -> Assignment:
    """Return the assignments (B, D, N) of the last `layers` layers."""
    return jax.tree.map(lambda leaf: leaf[:, leaf.shape[1] - layers :], assignment)


def positives(assignment: Assignment) -> Float[Array, " layers"]:
    """Return the number of matched queries of a batch per layer, at least 1; published code divides sums by it."""
    return jnp.maximum(assignment.matched.sum((0, 2)).astype(jnp.float32), 1.0)


def over_matched(
    weight: float, sums: Float[Array, "b layers"], assignment: Assignment, mean: ClassMean
) -> Float[Array, " layers"]:
    """Return weighted sums over the queries of each example, divided by numbers of matched queries, for each layer.

    Args:
        weight: of the term.
        sums: of one loss, over the queries.
        assignment: (B, D, N).
        mean: "batch": all sums are divided by `positives`. "frame": each sum by the number of its own example, at least
            1, and the quotients are averaged, as published code with one example on each device does.
    """
    if mean == "batch":
        return weight * sums.sum(0) / positives(assignment)
    return weight * (sums / jnp.maximum(assignment.matched.sum(2).astype(jnp.float32), 1.0)).mean(0)


def matched(assignment: Assignment) -> Float[Array, ""]:
    """Return the mean number of matched targets per example, in the last layer."""
    return assignment.matched[:, -1].sum(-1).astype(jnp.float32).mean()
