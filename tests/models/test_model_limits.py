"""Settings of models that no array could have: each is named before anything is computed."""

import dataclasses

import pytest

from tests.models.cases import BASELINE, CAMERA_TOPONET, LIFTED_LINES, SEGMENTS, WITH_TRAFFIC
from tflane_jax.limits import SettingError, check_settings
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.bev_encoder import SMALL_BEVFORMER
from tflane_jax.models.graph_encoders import GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.models.maptr import MapTrConfig


def changed(config, path, value):
    """Return a configuration with another value at a dotted path."""
    name, _, rest = path.partition(".")
    return dataclasses.replace(config, **{name: changed(getattr(config, name), rest, value) if rest else value})


BUCKET = dataclasses.replace(
    SEGMENTS, decoder=dataclasses.replace(SEGMENTS.decoder, classes=1), areas=AreaDecoderConfig(dim=16, heads=2)
)
CASES = [
    (WITH_TRAFFIC, "priors.traffic_flow.module.fusions", ("L->L", "T->T"), "such that L->T is among them"),
    (BASELINE, "encoder.dim", 12, "a multiple of 8"),
    (BASELINE, "encoder.levels", (16, 12), "multiples of 8"),
    (CAMERA_TOPONET, "elements.dim", 32, r"encoder\.images\.pyramid\.dim \(16\)"),
    (CAMERA_TOPONET, "encoder.line_masks", True, "False: only MapTRv2"),
    (BUCKET, "areas.coordinates", 2, "3"),
    (BUCKET, "areas.classes", 3, "2"),
]


@pytest.mark.parametrize(("config", "path", "value", "allowed"), CASES, ids=[case[1] for case in CASES])
def test_a_setting_that_does_not_fit_the_others_is_named(config, path, value, allowed):
    config.build()
    with pytest.raises(SettingError, match=rf"^{path} is .*: it must be {allowed}"):
        changed(config, path, value).build()


def test_only_maptrv2_learns_depth_and_masks_in_the_images():
    """Regression: other hosts took the settings and learned neither, without a word."""
    LIFTED_LINES.build()
    with pytest.raises(SettingError, match=r"^encoder\.line_masks is True: it must be False: only MapTRv2 has a loss"):
        MapTrConfig(encoder=LIFTED_LINES.encoder).build()
    without = changed(LIFTED_LINES.encoder, "line_masks", False)
    with pytest.raises(SettingError, match=r"^encoder\.bev\.supervised is True: it must be False: only MapTRv2"):
        MapTrConfig(encoder=without).build()


@pytest.mark.parametrize("config", [BASELINE, LIFTED_LINES])
def test_only_lane_segments_need_a_multiple_of_eight_sampling_points(config):
    changed(config, "decoder.sampling_points", 12).build()
    with pytest.raises(SettingError, match=r"^decoder.sampling_points is 12: it must be a multiple of 8 or less"):
        changed(SEGMENTS, "decoder.sampling_points", 12).build()


def test_a_kernel_of_cells_has_a_middle():
    kernel = dataclasses.replace(SMALL_BEVFORMER, attention="kernel", levels=1)
    check_settings(kernel)
    with pytest.raises(SettingError, match=r"^kernel is .*: it must be of odd numbers"):
        check_settings(dataclasses.replace(kernel, kernel=(2, 3)))


def test_channels_of_the_lift_encode_positions():
    narrow = changed(LIFTED_LINES, "encoder.images.pyramid.dim", 18)
    with pytest.raises(SettingError, match=r"^encoder\.bev\.dim is 18: it must be a multiple of 4"):
        changed(narrow, "encoder.bev.dim", 18).build()


@pytest.mark.parametrize(
    ("encoder", "message"),
    [
        (GtnEncoderConfig(channels=3), r"^encoder\.channels is 3: it must be a divisor of dim \(8\)"),
        (GtnEncoderConfig(heads=5), r"^encoder\.heads is 5: it must be a divisor of dim \(8\)"),
        (HanEncoderConfig(heads=3), r"^encoder\.heads is 3: it must be a divisor of dim \(8\)"),
        (GtnEncoderConfig(relations=(), similarity=None), r"^encoder\.relations is \(\): it must be at least one, or"),
        (
            GtnEncoderConfig(relations=()),
            r"^encoder\.relations is \(\): it must be at least one, or similarity every_hop",
        ),
        (HanEncoderConfig(relations=()), r"^encoder\.relations is \(\): it must be .*at least one of them"),
    ],
)
def test_impossible_encoders_of_lstr_are_named(encoder, message):
    with pytest.raises(SettingError, match=message):
        LstrConfig(dim=8, encoder=encoder).build()
