"""MapTR from six cameras of the built-in world, at a size for two cores.

    tflane train --config camera/maptr
    tflane train --config camera/maptr:tfm

Cameras, scenes and optimizer are those of `toponet.py`. As in MapTR, one level of feature maps goes through the
geometry-guided kernel; the decoder and the losses are the small ones of `tf_lane/maptr.py`. Not trained to the end yet.

`:city` has scenes of the preset `city`, whose tracks look back 10 s instead of 2 s. `:tfm` adds the traffic-flow module
of `tf_lane/toponet_tfm.py` to it, and `:tfm_control` is that model trained without traffic, with equal parameters.
"""

from dataclasses import replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_ablations, load_config, with_priors_of
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.procedural import CITY_EXAMPLE
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.image_encoder import ImageEncoderConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

# Stride 16: 15 x 9 cells of an image. Stride 32, as in the paper, would leave 8 x 5.
IMAGES = ImageEncoderConfig(stages=(2,), pyramid=FeaturePyramidConfig(64, 1))
DECODER = LineDecoderConfig(layers=2, queries=24, points=20, heads=4, anchors="spread", output="metric")
LOSSES = MapTrLossConfig(class_target="quality", least_step=0.1)
TRAFFIC = str(Path(__file__).parents[1] / "tf_lane/toponet_tfm.py")


def get_config() -> RunConfig:
    """Return the small camera model."""
    toponet = load_config(str(Path(__file__).with_name("toponet.py")))
    assert isinstance(toponet.task, LaneGraphTask)
    assert isinstance(toponet.data, WorldData)
    host = toponet.task.model
    assert isinstance(host, TopoNetConfig)
    assert isinstance(host.encoder, CameraEncoderConfig)
    assert isinstance(host.encoder.bev, BevFormerConfig)
    # A head of the kernel for each of the four points of a pillar.
    bev = replace(host.encoder.bev, levels=1, heads=4, attention="kernel", memory="off")
    model = MapTrConfig(
        encoder=CameraEncoderConfig(IMAGES, bev),
        range=host.range,
        decoder=DECODER,
        denoising=DenoisingConfig(copies=1),
    )
    lines = MapLinesConfig(lines=32, points=DECODER.points)
    data = replace(toponet.data, example=replace(toponet.data.example, map_lines=lines))
    training = replace(toponet.training, best_metric="lines/mAP")
    return replace(toponet, task=LaneGraphTask(model, LOSSES), data=data, training=training)


def ablations() -> dict[str, RunConfig]:
    """Return the model on scenes of `city`, with the traffic-flow module, and with that trained without traffic."""
    config, traffic = get_config(), load_ablations(TRAFFIC)
    assert isinstance(config.data, WorldData)
    example = replace(config.data.example, history_hz=CITY_EXAMPLE.history_hz, tracks=CITY_EXAMPLE.tracks)
    city = replace(config, data=replace(config.data, world=WorldData.city().world, example=example))
    rows = {"tfm": traffic["street"], "tfm_control": traffic["street_control"]}
    return {"city": city} | {name: with_priors_of(row, city) for name, row in rows.items()}
