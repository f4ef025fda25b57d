"""Temporal marker memory (Wu and Hu, section III-C): an explicit carry of fixed size, without parameters.

The bank has one slot for each of the last T frames, with the lanes of that frame's markers and their confidence. The
paper stores encoded tokens. This bank stores the polylines instead, which is equivalent at inference and allows
compensation of the ego motion.

Slots and decay count frames, not seconds: with the frames half a second apart of training, T = 6 slots are 3 s, at
10 Hz they are 0.6 s. A drive must be fed at the rate of training, and a pause longer than the bank is a new start
(`tasks.marker_drive`, `tflane markers run --interval`). In data sets every frame but the first of a scene continues the
memory: key frames that are missing in between do not age it. Lanes that the motion takes out of the perception range
stay in the bank, with coordinates outside [0, 1] in Eq. (1).

Choices that the paper leaves open (the first two are options):

- The paper mentions no compensation of the ego motion. `compensation="ego_motion"` transforms stored lanes into the
  present ego frame; "none" keeps their coordinates.
- Eq. (3) has one confidence c, but every stored token has its own, and Eq. (4) has scaled it already. `gate="once"`
  takes the largest decayed confidence for c and scales tokens relative to it, as those of a frame with several markers
  are: a token enters with its decayed confidence. "strongest" takes the same c and scales by Eq. (4) as written, so
  that a token enters with about the square. "one" leaves all scaling to Eq. (4).
- T, gamma, alpha and epsilon are not given; the defaults are ours.
- Slots are the last T frames, with or without markers; "the most recent T observations" may also mean frames with
  markers.
- With several markers in a frame, c_t is the highest confidence; lanes of the others are scaled relative to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.limits import Count, Factor, Fraction
from tflane_jax.priors.markers import MarkerLanes


@dataclass(frozen=True)
class MarkerMemoryConfig:
    """Size and decay of the memory.

    Attributes:
        frames: T, slots of the bank, including the present frame.
        decay: gamma, in (0, 1]; 1 is the ablation without decay.
        exponent: alpha of Eq. (4), in (0, 1].
        threshold: epsilon; a frame with a lower confidence, or without lanes of markers, uses the bank.
        lanes: largest number of prior tokens, those with the largest weights; None is the whole union of Eq. (4), T L
            lanes. The encoder's time grows with this number.
        compensation: of the ego motion, for stored lanes.
        gate: c of Eq. (3) for tokens from the bank, and what their weights are relative to; see above.
    """

    frames: Count = 6
    decay: Factor = 0.9
    exponent: Factor = 1.0
    threshold: Fraction = 0.1
    lanes: Count | None = None
    compensation: Literal["ego_motion", "none"] = "ego_motion"
    gate: Literal["once", "strongest", "one"] = "once"


@struct.dataclass
class MarkerMemory:
    """The bank: slot i holds the observations of i frames ago.

    Attributes:
        points: (T, L, K, 2) metres, ego frame of the latest frame.
        confidence: (T, L) at observation, before decay; 0 where not valid.
        successor: (T, L, L).
        valid: (T, L).
    """

    points: Float[Array, "t l k 2"]
    confidence: Float[Array, "t l"]
    successor: Bool[Array, "t l l"]
    valid: Bool[Array, "t l"]

    @classmethod
    def empty(cls, frames: int, lanes: int, points: int) -> MarkerMemory:
        """Return an empty bank of T frames for L lanes of K points per frame.

        `remember` takes it with T = `MarkerMemoryConfig.frames`, and L and K = `MarkerPriorConfig.lanes` and `points`.
        """
        zeros: Any = np.zeros  # typed as JAX arrays; numpy arrays work as well
        return cls(
            points=zeros((frames, lanes, points, 2), np.float32),
            confidence=zeros((frames, lanes), np.float32),
            successor=zeros((frames, lanes, lanes), bool),
            valid=zeros((frames, lanes), bool),
        )


@struct.dataclass
class MarkerGuidance:
    """Weighted lanes that guide one frame: those of the union of Eq. (4), or those of the frame alone.

    The encoder makes a token of each lane.

    Attributes:
        points: (N, K, 2) metres, ego frame.
        weight: (N,) factor of each lane's token; 0 where not valid.
        confidence: (N,) of the marker of each lane, decayed if it is remembered; 0 where not valid.
        gate: () c of Eq. (3); 0 without lanes.
        successor: (N, N) directed connectivity, between lanes of the same frame.
        valid: (N,).
    """

    points: Float[Array, "n k 2"]
    weight: Float[Array, " n"]
    confidence: Float[Array, " n"]
    gate: Float[Array, ""]
    successor: Bool[Array, "n n"]
    valid: Bool[Array, " n"]


def guidance(observed: MarkerLanes, exponent: float = 1.0) -> MarkerGuidance:
    """Return the guidance of a frame without memory."""
    strongest = observed.frame_confidence
    relative = observed.confidence / jnp.where(strongest > 0, strongest, 1.0)
    return MarkerGuidance(
        points=jnp.asarray(observed.points),
        weight=_power(relative, exponent),
        confidence=jnp.asarray(observed.confidence),
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
    """Return the memory for the next frame and the guidance of this one.

    Args:
        memory: of the previous frame.
        observed: lanes of this frame's markers, padded to the slot's L lanes.
        previous_from_ego: pose of this ego frame in the previous one; ignored without a previous frame.
        has_previous: False at the start of a scene; the memory is then ignored.
        config: size and decay.

    Raises:
        ValueError: the memory has not `config.frames` slots of L lanes of K points.
    """
    size, wanted = memory.points.shape[:3], (config.frames, *observed.points.shape[:2])
    if size != wanted:
        raise ValueError(
            f"the memory is MarkerMemory.empty{size}, and the configuration (frames) and what is observed (lanes and "
            f"their points) need MarkerMemory.empty{wanted}"
        )
    bank = _advance(memory, observed, previous_from_ego, has_previous, config)
    return bank, _read(bank, observed, config)


def _advance(
    memory: MarkerMemory,
    observed: MarkerLanes,
    previous_from_ego: Float[Array, "4 4"],
    has_previous: Bool[Array, ""],
    config: MarkerMemoryConfig,
) -> MarkerMemory:
    """Return the bank with this frame in slot 0 and every earlier one a slot further, in the present ego frame."""
    kept = memory.valid & has_previous
    points = memory.points
    if config.compensation == "ego_motion":
        own = jnp.asarray(previous_from_ego, points.dtype)  # the bank keeps its dtype, also in 64-bit mode
        points = _to_present(points, jnp.where(has_previous, own, jnp.eye(4, dtype=points.dtype)))
    return MarkerMemory(
        points=_push(observed.points, jnp.where(kept[..., None, None], points, 0.0)),
        confidence=_push(observed.confidence, jnp.where(kept, memory.confidence, 0.0)),
        successor=_push(observed.successor, memory.successor & kept[..., None]),
        valid=_push(observed.valid, kept),
    )


def _read(bank: MarkerMemory, observed: MarkerLanes, config: MarkerMemoryConfig) -> MarkerGuidance:
    """Return the guidance of a frame: the union of all slots if it reads the bank, else its own lanes (slot 0)."""
    age = jnp.arange(config.frames)
    decayed = bank.confidence * (config.decay**age).astype(bank.confidence.dtype)[:, None]  # c-hat of III-C
    alone = guidance(observed, config.exponent)
    reads = jnp.asarray(reads_bank(observed, config))
    strongest = decayed.max(initial=0.0)
    scale = jnp.where(strongest > 0, strongest, 1.0) if config.gate == "once" else 1.0
    of_union = _power(decayed / scale, config.exponent)  # Eq. (4)
    gate_of_union = jnp.where(strongest > 0, 1.0, 0.0) if config.gate == "one" else strongest
    used = bank.valid & (reads | (age == 0))[:, None]
    # The frame's own weights stand in every slot; `used` leaves those of slot 0.
    weight = jnp.where(used, jnp.where(reads, of_union, alone.weight[None]), 0.0)
    gate = jnp.where(reads, gate_of_union, alone.gate)
    return _union(bank, weight, jnp.where(used, decayed, 0.0), used, gate, config.lanes)


def reads_bank(observed: MarkerLanes, config: MarkerMemoryConfig) -> Bool[Array, ""]:
    """Return whether a frame uses the bank: it has no lanes of markers, or its confidence is below epsilon."""
    return (observed.frame_confidence < config.threshold) | ~observed.valid.any()


def _union(
    bank: MarkerMemory,
    weight: Float[Array, "t l"],
    confidence: Float[Array, "t l"],
    used: Bool[Array, "t l"],
    gate: Array,
    most: int | None,
) -> MarkerGuidance:
    """Return the lanes of all slots, or the `most` lanes with the largest weights, the latest first among equals."""
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
        confidence=confidence.reshape(-1)[chosen],
        gate=gate,
        valid=used[chosen],
        successor=bank.successor[slot[:, None], lane[:, None], lane[None, :]] & together,
    )


def _push(newest: Array, slots: Array) -> Array:
    """Return the slots shifted by one frame: the newest is first, the oldest is dropped."""
    return jnp.concatenate([jnp.asarray(newest, slots.dtype)[None], slots[:-1]])


def _to_present(points: Float[Array, "t l k 2"], previous_from_ego: Float[Array, "4 4"]) -> Float[Array, "t l k 2"]:
    """Return points of the previous ego frame in the present one, by the inverse pose in the plane."""
    rotation, shift = previous_from_ego[:2, :2], previous_from_ego[:2, 3]
    # With pitch and roll the upper left block is not orthogonal, so the transpose is not its inverse.
    # Full precision, as of `geometry.namespace.product`: the same lanes are moved in every frame.
    inverse, moved = jnp.linalg.inv(rotation), points - shift[None, None, None]
    return jnp.einsum("ij,tlkj->tlki", inverse, moved, precision="highest")


def _power(base: Array, exponent: float) -> Array:
    """Return base ** exponent, 0 with a finite gradient at 0."""
    return jnp.where(base > 0, jnp.where(base > 0, base, 1.0) ** exponent, 0.0)
