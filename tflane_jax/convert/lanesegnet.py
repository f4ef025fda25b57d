"""Weights of the head of the published LaneSegNet (github.com/OpenDriveLab/LaneSegNet) as our parameters."""

from __future__ import annotations

from tflane_jax.convert.renaming import Rule
from tflane_jax.convert.toponet import PLAIN_DECODER


def branch(name: str, ours: str, *, norm: bool = False, layers: int = 3) -> tuple[Rule, ...]:
    """Return the rules of one kind of branch: linear layers, numbered with the layers between them."""
    step = 3 if norm else 2
    linear = [
        (rf"{name}\.(\d+)\.{step * i}\.(weight|bias)", rf"heads_\1/{ours}/linear_{i}/\2", "linear")
        for i in range(layers)
    ]
    norms = [
        (rf"{name}\.(\d+)\.{step * i + 1}\.(weight|bias)", rf"heads_\1/{ours}/norm_{i}/\2", "norm")
        for i in range(layers - 1)
    ]
    return (*linear, *(norms if norm else ()))


LANESEGNET_HEAD: tuple[Rule, ...] = (
    *PLAIN_DECODER,
    *branch("cls_branches", "class", norm=True),
    *branch("cls_left_type_branches", "left_type", norm=True),
    *branch("cls_right_type_branches", "right_type", norm=True),
    *branch("reg_branches", "points"),
    *branch("reg_branches_offset", "offset"),
    *branch("mask_embed", "mask"),
)
