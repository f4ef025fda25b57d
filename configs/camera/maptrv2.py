"""MapTRv2 from six cameras of the built-in world, lifted by depth, at a size for two cores.

    tflane train --config camera/maptrv2
    tflane train --config camera/maptrv2:tfm

Scenes, image encoder, decoder sizes and optimizer are those of `maptr.py`; the world gives the depth of every image
cell. As in MapTRv2: decoupled attention, a one-to-many group in place of denoising queries, masks of lines in BEV and
in the images, depth loss. The ablations are those of `maptr.py`. Not trained to the end yet.
"""

from dataclasses import fields, replace
from pathlib import Path

from tflane_jax.config import RunConfig, WorldData, load_ablations, load_config
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.lift import LiftConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import CameraRigConfig

MAPTR = str(Path(__file__).with_name("maptr.py"))
# Pixels of a cell of the feature maps.
STRIDE = 16
# As many lines in the second group as in the first; MapTRv2 has six times as many, and repeats lines six times.
REPEATS = 2


def get_config() -> RunConfig:
    """Return the small camera model."""
    return _second(load_config(MAPTR))


def ablations() -> dict[str, RunConfig]:
    """Return the rows of `maptr.py` on MapTRv2."""
    return {name: _second(row) for name, row in load_ablations(MAPTR).items()}


def _second(maptr: RunConfig) -> RunConfig:
    """Return a configuration of MapTR with MapTRv2 in its place."""
    assert isinstance(maptr.task, LaneGraphTask)
    assert isinstance(maptr.data, WorldData)
    host, losses, rig = maptr.task.model, maptr.task.losses, maptr.data.example.cameras
    assert isinstance(host, MapTrConfig)
    assert isinstance(losses, MapTrLossConfig)
    assert isinstance(host.encoder, CameraEncoderConfig)
    assert isinstance(host.encoder.bev, BevFormerConfig)
    assert isinstance(rig, CameraRigConfig)
    grid = host.encoder.bev.grid
    lift = LiftConfig(
        replace(grid, range=replace(grid.range, z=(-10.0, 10.0))),
        dim=host.encoder.bev.dim,
        depth=(1.0, 35.0, 1.0),
        pyramid=24,
        dropout=0.0,
        image_scale=rig.scale,
        supervised=True,
    )
    model = MapTrV2Config(
        encoder=CameraEncoderConfig(host.encoder.images, lift, line_masks=True),
        range=host.range,
        priors=host.priors,
        decoder=host.decoder,
        many=host.decoder.queries,
        line_mask=True,
    )
    shared = {field.name: getattr(losses, field.name) for field in fields(losses)}
    data = replace(maptr.data, example=replace(maptr.data.example, cameras=replace(rig, depth_cell=STRIDE)))
    return replace(maptr, task=LaneGraphTask(model, MapTrV2LossConfig(many_repeats=REPEATS, **shared)), data=data)
