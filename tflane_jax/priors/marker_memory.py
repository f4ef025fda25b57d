"""Temporal marker memory (Wu and Hu, section III-C): an explicit carry of fixed size, without parameters.

The bank holds one slot for each of the last T frames: the lanes that markers gave in it and how far they were trusted.
The paper keeps encoded tokens; the bank keeps the polylines that they are encoded from, which is the same at inference
and lets them be moved with the vehicle.

What the paper leaves open, and the choice here (each an option):

- A marker moves in the ego frame while it is remembered, and the paper does not say that it is moved back:
  `compensation="ego_motion"` does; "none" leaves it where it was seen.
- Eq. (3) has one confidence c, and remembered tokens have one each: `gate="strongest"` takes the largest decayed one,
  "one" leaves the scaling to Eq. (4).
- T, gamma, alpha and epsilon are not given; the defaults are ours.
- With several markers in a frame, c_t is that of the most trusted; lanes of the others are scaled down relative to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.priors.markers import MarkerLanes


@dataclass(frozen=True)
class MarkerMemoryConfig:
    """Size and fading of the memory.

    Attributes:
        frames: T, slots of the bank, the present frame's among them.
        decay: gamma, in (0, 1]; 1 is the ablation without decay.
        exponent: alpha of Eq. (4), in (0, 1].
        threshold: epsilon; a frame trusted less is answered from the bank.
        lanes: most lanes of the union that guide a frame, those with the largest weights; None is the whole union of
            Eq. (4). The bank holds T L lanes, the encoder's time goes with those that guide.
        compensation: whether remembered lanes are moved by the ego motion.
        gate: c of Eq. (3) for what comes from the bank.
    """

    frames: int = 6
    decay: float = 0.9
    exponent: float = 1.0
    threshold: float = 0.1
    lanes: int | None = None
    compensation: Literal["ego_motion", "none"] = "ego_motion"
    gate: Literal["strongest", "one"] = "strongest"


@struct.dataclass
class MarkerMemory:
    """The bank: slot i holds what was observed i frames ago; it is not valid where nothing was.

    Attributes:
        points: (T, L, K, 2) metres, ego frame of the frame that was seen last.
        confidence: (T, L) when observed; 0 where not valid.
        successor: (T, L, L).
        valid: (T, L).
    """

    points: Float[Array, "t l k 2"]
    confidence: Float[Array, "t l"]
    successor: Bool[Array, "t l l"]
    valid: Bool[Array, "t l"]

    @classmethod
    def empty(cls, frames: int, lanes: int, points: int) -> MarkerMemory:
        """Return a bank that remembers nothing, for L lanes of K points a frame."""
        zeros: Any = np.zeros  # numpy's arrays stand for JAX's everywhere
        return cls(
            points=zeros((frames, lanes, points, 2), np.float32),
            confidence=zeros((frames, lanes), np.float32),
            successor=zeros((frames, lanes, lanes), bool),
            valid=zeros((frames, lanes), bool),
        )


@struct.dataclass
class MarkerGuidance:
    """What guides the BEV features of one frame: the union of Eq. (4), or the frame's own lanes.

    Attributes:
        points: (N, K, 2) metres, ego frame.
        weight: (N,) what each token is multiplied by; 0 where not valid.
        gate: () c of Eq. (3); 0 without guidance.
        successor: (N, N) directed connectivity, among lanes that were seen together.
        valid: (N,).
    """

    points: Float[Array, "n k 2"]
    weight: Float[Array, " n"]
    gate: Float[Array, ""]
    successor: Bool[Array, "n n"]
    valid: Bool[Array, " n"]


def guidance(observed: MarkerLanes, exponent: float = 1.0) -> MarkerGuidance:
    """Return the guidance of a frame on its own, without memory."""
    strongest = observed.frame_confidence
    share = observed.confidence / jnp.where(strongest > 0, strongest, 1.0)
    return MarkerGuidance(
        points=jnp.asarray(observed.points),
        weight=_power(share, exponent),
        gate=jnp.asarray(strongest),
        successor=jnp.asarray(observed.successor),
        valid=jnp.asarray(observed.valid),
    )


def remember(
    memory: MarkerMemory,
    observed: MarkerLanes,
    previous_from_ego: Float[Array, "4 4"],
    has_previous: Bool[Array, ""],
    config: MarkerMemoryConfig,
) -> tuple[MarkerMemory, MarkerGuidance]:
    """Return the memory for the next frame, and the guidance of this one.

    Args:
        memory: of the frame before.
        observed: lanes of this frame's markers, as many as a slot holds.
        previous_from_ego: pose of this ego frame in the previous one's; looked at where there is a previous frame.
        has_previous: False begins a scene: nothing is remembered.
        config: see there.
    """
    kept = memory.valid & has_previous
    points = memory.points
    if config.compensation == "ego_motion":
        points = _to_present(points, jnp.where(has_previous, previous_from_ego, jnp.eye(4)))
    bank = MarkerMemory(
        points=_push(observed.points, jnp.where(kept[..., None, None], points, 0.0)),
        confidence=_push(observed.confidence, jnp.where(kept, memory.confidence, 0.0)),
        successor=_push(observed.successor, memory.successor & kept[..., None]),
        valid=_push(observed.valid, kept),
    )
    age = jnp.arange(config.frames)
    decayed = bank.confidence * (config.decay**age)[:, None]  # c-hat of III-C
    alone = guidance(observed, config.exponent)
    retrieve = alone.gate < config.threshold
    weight = jnp.where(retrieve, _power(decayed, config.exponent), 0.0)  # Eq. (4)
    weight = weight.at[0].set(jnp.where(retrieve, weight[0], alone.weight))
    strongest = decayed.max(initial=0.0)
    from_bank = strongest if config.gate == "strongest" else jnp.where(strongest > 0, 1.0, 0.0)
    used = bank.valid & (retrieve | (age == 0))[:, None]
    gate = jnp.where(retrieve, from_bank, alone.gate)
    return bank, _union(bank, jnp.where(used, weight, 0.0), used, gate, config.lanes)


def _union(
    bank: MarkerMemory, weight: Float[Array, "t l"], used: Bool[Array, "t l"], gate: Array, most: int | None
) -> MarkerGuidance:
    """Return the lanes of all slots in one row; the heaviest `most` of them, the youngest first among equals."""
    slots, lanes, k = bank.points.shape[:3]
    points, weight, used = bank.points.reshape(slots * lanes, k, 2), weight.reshape(-1), used.reshape(-1)
    chosen = jnp.arange(slots * lanes)
    if most is not None and most < slots * lanes:
        chosen = jnp.argsort(jnp.where(used, -weight, jnp.inf), stable=True)[:most]
    slot, lane = chosen // lanes, chosen % lanes
    together = slot[:, None] == slot[None, :]
    return MarkerGuidance(
        points=points[chosen],
        weight=weight[chosen],
        gate=gate,
        valid=used[chosen],
        successor=bank.successor[slot[:, None], lane[:, None], lane[None, :]] & together,
    )


def _push(newest: Array, slots: Array) -> Array:
    """Return the slots one frame older, without the oldest, the newest in front."""
    return jnp.concatenate([jnp.asarray(newest, slots.dtype)[None], slots[:-1]])


def _to_present(points: Float[Array, "t l k 2"], previous_from_ego: Float[Array, "4 4"]) -> Float[Array, "t l k 2"]:
    """Return points of the previous ego frame in this one's, in the plane: the inverse of a planar pose."""
    rotation, shift = previous_from_ego[:2, :2], previous_from_ego[:2, 3]
    # Pitch and roll leave the upper left block not quite orthogonal, so its inverse is not its transpose.
    return jnp.einsum("ij,tlkj->tlki", jnp.linalg.inv(rotation), points - shift[None, None, None])


def _power(base: Array, exponent: float) -> Array:
    """Return base ** exponent, 0 with a finite gradient at 0."""
    return jnp.where(base > 0, jnp.where(base > 0, base, 1.0) ** exponent, 0.0)
