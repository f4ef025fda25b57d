"""Whole detectors: the reference's checkpoints as parameters of our hosts.

All of them call the image encoder `img_backbone` and `img_neck`, the BEV encoder `bev_constructor`, the head of traffic
elements `bbox_head`, that of lanes `pts_bbox_head`, and topology heads beside it `lclc_head` and `lcte_head`; in
LaneSegNet's map-element-bucket variant these are `lsls_head` and `lste_head`, and areas have the `area_head`. MapTR's
BEV encoder is part of its head. SMERF adds a `map_encoder` to TopoNet and the baseline, and attention to the map in
`bev_constructor`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tflane_jax.convert.bevformer import BEV_CONSTRUCTER, IMAGE_ENCODER
from tflane_jax.convert.fitting import Expected, Missing, expected_variables, fitted
from tflane_jax.convert.lanesegnet import LANESEGNET_HEAD
from tflane_jax.convert.maptr import MAPTR_HEAD, MAPTRV2_HEAD, area_head
from tflane_jax.convert.renaming import Converted, Rule, below, check_types, convert, naming
from tflane_jax.convert.sd_map import SD_MAP_ENCODER, SMERF_CONSTRUCTER
from tflane_jax.convert.toponet import BASELINE_LANES, ELEMENTS, RELATIONSHIP, TOPONET_LANES
from tflane_jax.convert.torch_file import read_checkpoint
from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.models.parameters import Params
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import CameraViews, Example, VehicleState

PublishedHost = TopoNetConfig | BevFormerDetrConfig | LaneSegNetConfig | MapTrConfig


def _head_rules(model: PublishedHost) -> tuple[str, tuple[Rule, ...]]:
    """Return a detector's name and the rules of its heads."""
    elements = below(r"bbox_head\.", "elements", ELEMENTS)
    if isinstance(model, TopoNetConfig):
        return "TopoNet", (*elements, *below(r"pts_bbox_head\.", "", TOPONET_LANES))
    if isinstance(model, LaneSegNetConfig):
        segments = below(r"pts_bbox_head\.", "", LANESEGNET_HEAD)
        if model.areas is None:
            return "LaneSegNet", (*segments, *below(r"lclc_head\.", "successor", RELATIONSHIP))
        return "LaneSegNet's map-element-bucket variant", (
            *segments,
            *below(r"lsls_head\.", "successor", RELATIONSHIP),
            *elements,
            *below(r"lste_head\.", "element_lane", RELATIONSHIP),
            *below(r"area_head\.", "areas", area_head(model.areas.class_layers)),
        )
    if isinstance(model, MapTrV2Config):
        return "MapTRv2", below(r"pts_bbox_head\.", "", MAPTRV2_HEAD)
    if isinstance(model, MapTrConfig):
        return "MapTR", below(r"pts_bbox_head\.", "", MAPTR_HEAD)
    last = f"heads_{model.decoder.layers - 1}"
    return "BEVFormer-DETR", (
        *elements,
        *below(r"pts_bbox_head\.", "", BASELINE_LANES),
        *below(r"lclc_head\.", f"{last}/successor", RELATIONSHIP),
        *below(r"lcte_head\.", f"{last}/element_lane", RELATIONSHIP),
    )


def _rules(model: PublishedHost) -> tuple[str, tuple[Rule, ...]]:
    """Return the network's name and the rules of all of its tensors."""
    network, heads = _head_rules(model)
    sd_map = model.priors.sd_map is not None
    return f"{network} with SMERF" if sd_map else network, (
        *below("", "encoder/images", IMAGE_ENCODER),
        *below(r"bev_constructor\.", "encoder/bev", SMERF_CONSTRUCTER if sd_map else BEV_CONSTRUCTER),
        *(below(r"map_encoder\.", "sd_map_tokens", SD_MAP_ENCODER) if sd_map else ()),
        *heads,
    )


def convert_host(state: Mapping[str, AnyArray], model: PublishedHost) -> Converted:
    """Return the variables of a whole host with cameras, and an account of every tensor.

    Args:
        state: tensors of the reference's detector, with or without the prefix `module.`.
        model: decides how many layers there are, whether the backbone's norms are constants, and whether there is a map
            encoder.

    Raises:
        UserError: a tensor that the detector does not have.
    """
    network, rules = _rules(model)
    frozen = isinstance(model.encoder, CameraEncoderConfig) and model.encoder.images.backbone.frozen_norms
    norms = r"encoder/images/backbone/(.*/)?\w*bn\d?/.*" if frozen else "(?!)"
    return convert(state, rules, network, frozen=norms)


def load_host(
    path: Path, model: PublishedHost, missing: Missing = "left out", entry: str | None = None
) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from the reference's checkpoint (.pth, .pkl, .npz), and the account of its tensors.

    Args:
        path: the checkpoint.
        model: with cameras.
        missing: what becomes of auxiliary heads that the file does not have.
        entry: path of the weights in the file, see `torch_file.read_checkpoint`.

    Raises:
        UserError: the file cannot be read, or its tensors are not exactly those of the model.
    """
    if not isinstance(model.encoder, CameraEncoderConfig):
        raise UserError(
            f"{path}: published weights are those of models with cameras: give the model an encoder of cameras"
        )
    with naming(path):
        checkpoint = read_checkpoint(path, entry)
        check_types(checkpoint.others, _rules(model)[1])
        converted = convert_host(checkpoint.tensors, model)
    params, table = fitted(converted, _expected(model), path, missing)
    return params, table + checkpoint.passed_over()


@functools.lru_cache(maxsize=2)
def _expected(model: PublishedHost) -> Expected:
    assert isinstance(model.encoder, CameraEncoderConfig)
    return expected_variables(model.build(), (camera_shapes(model.encoder),))


def camera_shapes(encoder: CameraEncoderConfig) -> Any:
    """Return the shapes of an example; parameters do not depend on the size of its images."""
    count, side = encoder.bev.cameras, 128
    shape = jax.ShapeDtypeStruct
    cameras = CameraViews(
        image=shape((count, side, side, 3), jnp.uint8),
        size=shape((count, 2), jnp.int32),
        intrinsics=shape((count, 3, 3), jnp.float32),
        camera_from_ego=shape((count, 4, 4), jnp.float32),
        valid=shape((count,), jnp.bool_),
        vehicle=VehicleState(shape((4, 4), jnp.float32), shape((4, 4), jnp.float32), shape((18,), jnp.float32)),
    )
    nothing = dict.fromkeys(field.name for field in dataclasses.fields(Example))
    pose, flag = shape((4, 4), jnp.float32), shape((), jnp.bool_)
    return Example(**nothing | {"cameras": cameras, "previous_from_ego": pose, "has_previous": flag})  # pyright: ignore
