"""Checkpoints of whole detectors: every tensor is accounted for, and none is missing."""

import dataclasses

import numpy as np
import pytest

from tests.golden import golden_entries, load_module_case
from tests.slow import with_slow
from tflane_jax.convert.hosts import convert_host, load_host
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.layers.polyline_encoder import PolylineEncoderConfig
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.element_decoder import ElementDecoderConfig
from tflane_jax.models.image_encoder import ImageEncoderConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.models.lane_segments import SegmentDecoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.lift import LiftConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SdMapModuleConfig
from tflane_jax.models.toponet import TopoNetConfig

ENCODER = CameraEncoderConfig(
    ImageEncoderConfig(
        ResNetConfig((2, 2, 2, 2), (4, 8, 16, 32), stem_channels=4, frozen_norms=True),
        pyramid=FeaturePyramidConfig(16, 2),
    ),
    BevFormerConfig(BevGrid(rows=5, columns=8), dim=16, heads=4, layers=1, hidden=32, levels=2, cameras=3),
)
ELEMENTS = ElementDecoderConfig(dim=16, heads=4, layers=2, queries=6, hidden=24)
DECODER = LaneDecoderConfig(dim=16, heads=4, layers=2, queries=8, hidden=24, relation=128, refine="fixed")
TOPONET = TopoNetConfig(encoder=ENCODER, decoder=DECODER, elements=ELEMENTS)
BASELINE = BevFormerDetrConfig(
    encoder=ENCODER,
    decoder=LaneDecoderConfig(dim=16, heads=4, layers=2, queries=6, hidden=24, relation=128, refine="fixed"),
    elements=ELEMENTS,
    control_points=5,
)


def fixture(name, prefix):
    path = golden_entries().get(f"modules/{name}")
    if path is None:
        pytest.skip("needs the golden files under $TFLANE_SHARED")
    return {prefix + key: value for key, value in load_module_case(path).params.items()}


def checkpoint(lanes, relations=()):
    """Return a detector's tensors, named as its parts name them; the pyramid's sizes are those of the backbone."""
    state = fixture("resnet18_eval", "img_backbone.")
    for i, channels in enumerate((16, 32)):
        for kind, inputs, size in (("lateral", channels, 1), ("fpn", 16, 3)):
            state[f"img_neck.{kind}_convs.{i}.conv.weight"] = np.ones((16, inputs, size, size), np.float32)
            state[f"img_neck.{kind}_convs.{i}.conv.bias"] = np.ones(16, np.float32)
    state |= fixture("bev_constructer_toponet_noprev", "bev_constructor.") | fixture("toponet_te_head", "bbox_head.")
    state |= fixture(lanes, "pts_bbox_head.")
    for head in relations:
        state |= fixture("toponet_relationship_head", f"{head}.")
    return state


def lanesegnet_checkpoint():
    """Return LaneSegNet's tensors; it has no head of traffic elements."""
    state = checkpoint("laneseg_head_train")
    state = {name: value for name, value in state.items() if not name.startswith("bbox_head.")}
    return state | fixture("laneseg_relationship_head", "lclc_head.")


def bucket_checkpoint():
    """Return the tensors of LaneSegNet's map-element-bucket variant; its area head is MapTR's with other sizes."""
    state = {name: value for name, value in lanesegnet_checkpoint().items() if not name.startswith("lclc_head.")}
    for branch in ("weight", "bias"):  # one class, no crossing
        for i in range(2):
            name = f"pts_bbox_head.cls_branches.{i}.6.{branch}"
            state[name] = state[name][:1]
    for head in ("lsls_head", "lste_head"):
        state |= fixture("laneseg_relationship_head", f"{head}.")
    state |= fixture("toponet_te_head", "bbox_head.")
    for name, value in fixture("maptr_head_gkt", "area_head.").items():
        parts = name.split(".")
        if parts[1] not in ("transformer", "cls_branches", "reg_branches", "instance_embedding", "pts_embedding"):
            continue
        if parts[1] == "transformer" and parts[2] not in ("decoder", "reference_points"):
            continue  # the BEV encoder of MapTR's head
        if parts[1] == "cls_branches":  # one hidden layer less, and two classes
            if parts[3] in ("3", "4"):
                continue
            if parts[3] == "6":
                name, value = name.replace(".6.", ".3."), value[:2]
        if "reference_points" in name or (".4." in name and parts[1] == "reg_branches"):
            value = np.concatenate([value, value[:1]])  # z beside x and y
        state[name] = value
    return state | {"area_head.code_weights": np.ones(3, np.float32)}


LANESEGNET = LaneSegNetConfig(
    encoder=ENCODER,
    decoder=SegmentDecoderConfig(dim=16, heads=8, layers=2, queries=7, hidden=24, relation=128, sampling_points=8),
)


def maptr_checkpoint(head):
    """Return MapTR's tensors; as in the published files, the levels' embeddings have four rows."""
    state = {name: value for name, value in checkpoint(head).items() if name.startswith(("img_", "pts_bbox_head."))}
    state = {name: value for name, value in state.items() if "convs.1." not in name}
    for kind in ("lateral", "fpn"):  # of the coarsest stage alone
        inputs, size = (32, 1) if kind == "lateral" else (16, 3)
        state[f"img_neck.{kind}_convs.0.conv.weight"] = np.ones((16, inputs, size, size), np.float32)
    levels = "pts_bbox_head.transformer.level_embeds"
    return state | {levels: np.concatenate([state[levels], np.zeros((3, 16), np.float32)])}


def maptrv2_checkpoint():
    """Return MapTRv2's tensors; those of the lift are ones, of the fixture's shapes with the head's 16 channels."""
    state = {name: value for name, value in checkpoint("maptrv2_head_train").items() if "bev_constructor" not in name}
    state = {name: value for name, value in state.items() if name.startswith("pts_bbox_head.")} | {
        name: value for name, value in maptr_checkpoint("maptr_head_gkt").items() if name.startswith("img_")
    }
    for name, value in fixture("maptrv2_lss_transform", "pts_bbox_head.transformer.encoder.").items():
        shape = tuple(16 if size == 8 else size for size in value.shape)
        # The first axis of the last layer of the depth network is that of the bins.
        shape = (8, *shape[1:]) if ".depth_conv.4." in name else shape
        state[name] = np.ones(shape, np.float32)
    return state


def maptrv2():
    lift = LiftConfig(BevGrid(rows=6, columns=4), dim=16, cameras=3, depth=(1.0, 9.0, 1.0), pyramid=6)
    images = dataclasses.replace(ENCODER.images, stages=(3,), pyramid=FeaturePyramidConfig(16, 1))
    decoder = LineDecoderConfig(dim=16, heads=4, layers=2, queries=4, points=5, hidden=24)
    encoder = CameraEncoderConfig(images, lift, line_masks=True)
    return MapTrV2Config(encoder=encoder, decoder=decoder, many=6, line_mask=True)


def maptr(attention):
    bev = BevFormerConfig(
        BevGrid(rows=6, columns=4), dim=16, heads=4, layers=1, hidden=24, levels=1, cameras=3, attention=attention
    )
    images = dataclasses.replace(ENCODER.images, stages=(3,), pyramid=FeaturePyramidConfig(16, 1))
    decoder = LineDecoderConfig(dim=16, heads=4, layers=2, queries=5, points=4, hidden=24)
    return MapTrConfig(encoder=CameraEncoderConfig(images, bev), decoder=decoder)


def smerf_checkpoint():
    """Return TopoNet's tensors with SMERF's map encoder, as wide as the BEV features, and its BEV constructer."""
    state = {name: value for name, value in checkpoint("toponet_head").items() if "bev_constructor" not in name}
    state |= fixture("smerf_bev_constructer", "bev_constructor.")
    for name, value in fixture("smerf_map_graph_transformer", "map_encoder.").items():
        state[name] = np.ones(tuple({32: 16, 96: 48}.get(size, size) for size in value.shape), np.float32)
    return state


SMERF = dataclasses.replace(
    TOPONET,
    encoder=dataclasses.replace(
        ENCODER, bev=dataclasses.replace(ENCODER.bev, grid=BevGrid(rows=4, columns=6), hidden=24, value_projections=2)
    ),
    priors=PriorsConfig(sd_map=SdMapModuleConfig(lines=PolylineEncoderConfig(dim=16, layers=2, hidden=16))),
)
BUCKET = dataclasses.replace(
    LANESEGNET,
    decoder=dataclasses.replace(LANESEGNET.decoder, classes=1),
    elements=ELEMENTS,
    areas=AreaDecoderConfig(dim=16, heads=4, layers=2, queries=5, points=4, class_layers=1, hidden=24),
)
CASES = {
    "toponet": (TOPONET, lambda: checkpoint("toponet_head")),
    "toponet, smerf": (SMERF, smerf_checkpoint),
    "baseline": (BASELINE, lambda: checkpoint("olv2_lc_head", ("lclc_head", "lcte_head"))),
    "lanesegnet": (LANESEGNET, lanesegnet_checkpoint),
    "lanesegnet, bucket": (BUCKET, bucket_checkpoint),
    "maptr": (maptr("kernel"), lambda: maptr_checkpoint("maptr_head_gkt")),
    "maptrv2": (maptrv2(), maptrv2_checkpoint),
    "maptr, bevformer": (maptr("deformable"), lambda: maptr_checkpoint("maptr_head_bevformer")),
}


@pytest.mark.golden
@pytest.mark.parametrize("name", with_slow(CASES, quick=["maptrv2"]))
def test_every_tensor_of_a_detector_has_its_place(name, tmp_path):
    model, make = CASES[name]
    state, path = make(), tmp_path / "weights.npz"
    np.savez(path, **{f"module.{key}": value for key, value in state.items()})
    _, table = load_host(path, model)
    assert [row["tensor"] for row in table] == [f"module.{key}" for key in state]
    leaves = [leaf for row in table for leaf in row["becomes"].split(", ")]
    unused = [leaf for leaf in leaves if "not needed" in leaf or leaf.startswith("a ") or leaf.startswith("unused")]
    assert unused[-2:] == ["a constant of the loss", "not needed"] or name == "maptrv2"
    placed = [leaf for leaf in leaves if leaf not in unused]
    assert len(set(placed)) == len(placed)
    left_out = [row["tensor"].removeprefix("module.pts_bbox_head.") for row in table if "unused" in row["becomes"]]
    if name == "maptrv2":
        assert {tensor.split(".")[0] for tensor in left_out} == {
            "positional_encoding",
            "transformer",
            "loss_seg",
            "loss_pv_seg",
        }
        assert {"transformer.encoder.dx", "transformer.cams_embeds"} <= set(left_out)
    else:
        assert left_out == (["transformer.level_embeds"] if name.startswith("maptr") else [])

    incomplete = dict(state)
    del incomplete["pts_bbox_head.cls_branches.1.6.bias"]
    np.savez(path, **incomplete)
    with pytest.raises(UserError, match=r"heads_1/class.*bias is absent in the file and \d in the model"):
        load_host(path, model)
    np.savez(path, **incomplete, **{"pts_bbox_head.cls_branches.1.6.bias": np.array("lost")})
    with pytest.raises(UserError, match=r"cls_branches.1.6.bias holds text, expected floating-point numbers"):
        load_host(path, model)
    np.savez(path, **state, **{"pts_bbox_head.surplus.weight": np.zeros(3)})
    with pytest.raises(UserError, match="is no tensor of"):
        load_host(path, model)


@pytest.mark.golden
def test_norms_of_smerf_are_numbered_with_that_of_the_map():
    state = smerf_checkpoint()
    layer = convert_host(state, SMERF).variables["params"]["encoder"]["bev"]["encoder"]["layer_0"]
    norms = [state[f"bev_constructor.encoder.layers.0.norms.{i}.weight"] for i in (2, 3)]
    np.testing.assert_array_equal(layer["sd_map_0"]["norm"]["scale"], norms[0])
    np.testing.assert_array_equal(layer["feed_forward_norm"]["scale"], norms[1])
    with pytest.raises(
        UserError, match=r"map_encoder.* is no tensor of TopoNet|attentions.2.* is no tensor of TopoNet"
    ):
        convert_host(state, TOPONET)
