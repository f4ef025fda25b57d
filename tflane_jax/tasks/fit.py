"""Whether a host and its data fit together; every misfit is an error that names both settings."""

from __future__ import annotations

import warnings
from operator import attrgetter

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.data_source import LaneGraphSource
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.sources import source_name
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import SettingError
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.bevformer import check_capacity
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.host import HostConfig
from tflane_jax.models.lift import LiftConfig
from tflane_jax.scene import BevChannel, Example

_BORDER = 0.1
"""Metres by which a point may lie outside a range, for rounding."""
_OPTIONAL_PRIORS = ("sd_map", "markers")
"""Fields of `ExampleConfig`, `Example` and `PriorsConfig` that are None by default."""


def check_settings_fit(model: HostConfig, config: ExampleConfig, *, image_scale: float | None) -> None:
    """Raise UserError where data and model cannot fit together whatever the examples are.

    Checked are what the model reads (camera images and their scale, evidence, past frames, priors) and what it learns
    (ranges, numbers of points, forms of the truth, the lines of a map).

    Args:
        model: the host.
        config: of the examples.
        image_scale: of the camera images in examples, relative to the camera's own; None: there are no images.
    """
    _check_inputs(model, config, images=image_scale is not None)
    _check_scale(model, image_scale)
    _check_ranges(model, config)
    _check_heights(model, config)
    _check_raster(model, config)
    _check_lines(model, config)
    _check_marker_points(model, config)
    _check_points(model, config)
    _check_forms(model, config)
    _check_history(model, config)


def check_augmentation(model: HostConfig, augmentation: PhotometricConfig | None) -> None:
    """Raise SettingError where images are augmented in a way that the model cannot know of."""
    encoder = model.encoder
    if augmentation is None or not isinstance(encoder, CameraEncoderConfig) or not isinstance(encoder.bev, LiftConfig):
        return
    if augmentation.scale != (1.0, 1.0):
        why = "(1.0, 1.0): the depth network of LiftConfig gets the cameras' own intrinsics by one scale of all images"
        raise SettingError("data.augmentation.scale", augmentation.scale, why)


def check_fit(model: HostConfig, example: Example) -> None:
    """Raise UserError where an example lacks what the model reads, or a camera sees more cells than `capacity`."""
    if _learns_lines(model) and example.map_lines is None:
        raise UserError(_NO_LINES)
    if reads_traffic(model) and example.traffic_flow is None:
        raise UserError(
            "this model reads traffic flow (task.model.priors.traffic_flow), and the data have none: name the folder "
            "of the tracks (data.tracks) or leave the prior out"
        )
    _check_elements(model, example)
    encoder, cameras = model.encoder, example.cameras
    if isinstance(encoder, CameraEncoderConfig) and isinstance(encoder.bev, BevFormerConfig) and cameras is not None:
        seen = model.in_host_frame(example).cameras
        assert seen is not None
        check_capacity(encoder.bev, seen)


def check_raster(source: LaneGraphSource, example: Example) -> None:
    """Raise UserError where the evidence of an example has not the size that its source says: it is of another box."""
    if example.bev is None or (sensor := source.example.sensor) is None:
        return
    found, wanted = example.bev.shape, (sensor.grid.rows, sensor.grid.columns, len(BevChannel))
    if found != wanted:
        sizes = [" x ".join(map(str, shape)) for shape in (found, wanted)]
        raise UserError(
            f"examples of {source_name(source)} have a raster of {sizes[0]}, and their configuration says {sizes[1]} "
            "(rows and columns of example.sensor.grid, channels): a dataset makes examples of the sizes in `example`"
        )


def warn_of_lanes_beyond(source: LaneGraphSource, examples: Example) -> None:
    """Warn of lanes, of one example or of many, that leave the range in which a model is to predict them."""
    range_ = source.example.range
    low, high = _corners(range_)
    for name, lanes in (("lanes", examples.lanes), ("segments", examples.segments)):
        points = np.asarray(lanes.points)[np.asarray(lanes.valid)][..., :2]
        beyond = ((points < low - _BORDER) | (points > high + _BORDER)).any(-1)
        if beyond.any():
            warnings.warn(
                f"{100 * beyond.mean():.2g} % of the points of {name} in {source_name(source)} lie outside x "
                f"{range_.x}, y {range_.y} (example.range), where a model is not made to put them: cut lanes at the "
                "border (geometry.clip_to_range)",
                TruncationWarning,
                stacklevel=3,
            )


def _check_elements(model: HostConfig, example: Example) -> None:
    elements, wanted = example.traffic_elements, model.elements_of
    if model.elements is None or elements is None:
        return
    if (elements.segment if wanted == "segments" else elements.lane) is None:
        raise UserError(
            f"traffic elements of these data do not govern {wanted}, which this model learns: set "
            f"data.example.elements_of={wanted} (built-in world), or the flavour of OpenLane-V2 (data.flavour)"
        )


def frozen_modules(model: HostConfig) -> tuple[str, ...]:
    """Return the paths of the parts of the backbone that are not trained: the stem, then stages (their first block)."""
    encoder = model.encoder
    if not isinstance(encoder, CameraEncoderConfig):
        return ()
    parts = ("conv1", *(f"layer{stage + 1}_0" for stage in range(len(encoder.images.backbone.blocks))))
    return tuple(f"encoder/images/backbone/{part}" for part in parts[: encoder.images.frozen_stages])


def unread_priors(model: HostConfig, config: ExampleConfig) -> list[str]:
    """Return the names of the priors that examples have by a setting of their own and no prior of the host reads."""
    read = {name for prior in model.build_priors().values() for name in prior.reads}
    return [name for name in _OPTIONAL_PRIORS if getattr(config, name) is not None and name not in read]


def reads_traffic(model: HostConfig) -> bool:
    """Return whether the host reads traffic flow; the matched control, which reads no instances, does not."""
    traffic = model.priors.traffic_flow
    return traffic is not None and traffic.prior.top_instances != 0


def _check_ranges(model: HostConfig, config: ExampleConfig) -> None:
    encoder, bev_range = model.encoder, model.bev_range
    if isinstance(encoder, EvidenceEncoderConfig) and config.sensor is not None:
        raster = config.sensor.grid.range
        if raster != bev_range:
            raise UserError(
                f"the evidence raster covers x {raster.x}, y {raster.y} (data.example.sensor.grid.range), and the "
                f"model takes it for x {bev_range.x}, y {bev_range.y}: set task.model.encoder.range to the same"
            )
    labelled = _corners(config.range)
    if not bev_range.contains(labelled).all():
        raise UserError(
            f"lanes are labelled within x {config.range.x}, y {config.range.y} (data.example.range), beyond the "
            f"model's BEV features (x {bev_range.x}, y {bev_range.y}): make either range fit the other"
        )
    if model.priors.traffic_flow is not None and not bev_range.contains(_corners(model.range)).all():
        raise UserError(
            f"traffic flow reaches to x {model.range.x}, y {model.range.y} (task.model.range), beyond the model's BEV "
            f"features (x {bev_range.x}, y {bev_range.y}), in whose coordinates it is given: make either range fit"
        )
    ends = getattr(getattr(model, "decoder", None), "output", None) == "metric"
    if (ends or model.priors.traffic_flow is not None) and not model.range.contains(labelled).all():
        raise UserError(
            f"lanes are labelled within x {config.range.x}, y {config.range.y} (data.example.range), and the model's "
            f"{'lanes end' if ends else 'traffic flow ends'} at x {model.range.x}, y {model.range.y} "
            "(task.model.range): make either range fit the other"
        )


def _check_heights(model: HostConfig, config: ExampleConfig) -> None:
    low, high = config.range.z
    if low < model.range.z[0] or high > model.range.z[1]:
        raise UserError(
            f"lanes are labelled within z {config.range.z} (data.example.range), and the model's lanes end at z "
            f"{model.range.z} (task.model.range): make either range fit the other"
        )


def _corners(range_: PerceptionRange) -> Float[np.ndarray, "2 2"]:
    """Return the low and the high corner of a range in the ground plane."""
    return np.stack([range_.x, range_.y], -1)


def _check_raster(model: HostConfig, config: ExampleConfig) -> None:
    encoder = model.encoder
    if not isinstance(encoder, EvidenceEncoderConfig) or config.sensor is None:
        return
    grid = config.sensor.grid
    if grid.rows % encoder.cell or grid.columns % encoder.cell:
        raise UserError(
            f"the evidence raster has {grid.rows} x {grid.columns} cells (data.example.sensor.grid), which do not fold "
            f"into blocks of {encoder.cell} x {encoder.cell} (task.model.encoder.cell): choose a divisor of both"
        )


def _check_inputs(model: HostConfig, config: ExampleConfig, *, images: bool) -> None:
    evidence = isinstance(model.encoder, EvidenceEncoderConfig)
    if evidence and config.sensor is None:
        raise UserError(
            "this model reads BEV evidence (task.model.encoder), and the data have none: set data.example.sensor"
        )
    if not evidence and not images:
        raise UserError(
            "this model reads camera images (task.model.encoder), and the data have none: set data.example.cameras "
            "(built-in world) or data.image (nuScenes)"
        )
    for name in _OPTIONAL_PRIORS:
        if getattr(model.priors, name) is not None and getattr(config, name) is None:
            raise UserError(
                f"this model reads a prior (task.model.priors.{name}), and data.example.{name} is None: set that one "
                "as well, or leave the prior out"
            )


def _check_scale(model: HostConfig, image_scale: float | None) -> None:
    """Raise UserError if the lift's depth network is configured for images of another scale."""
    encoder = model.encoder
    if image_scale is None or not isinstance(encoder, CameraEncoderConfig) or not isinstance(encoder.bev, LiftConfig):
        return
    known = encoder.bev.image_scale
    if abs(known - image_scale) > 1e-6:
        raise UserError(
            f"images have {image_scale:g} times the camera's own size (data.image.scale, or data.example.cameras.scale "
            f"of the built-in world), and the model is told {known:g} (task.model.encoder.bev.image_scale): set the "
            "latter to the former"
        )


_NO_LINES = (
    "this model learns the lines of a vector map, and the data label none: set data.example.map_lines, which the "
    "built-in world, Argoverse 2 and nuScenes read"
)


def _learns_lines(model: HostConfig) -> bool:
    return "lines" in model.predicts and "map_lines" in model.truth


def _check_lines(model: HostConfig, config: ExampleConfig) -> None:
    if _learns_lines(model) and config.map_lines is None:
        raise UserError(_NO_LINES)


def _check_marker_points(model: HostConfig, config: ExampleConfig) -> None:
    prior, markers = model.priors.markers, config.markers
    if prior is not None and markers is not None and markers.points < prior.prior.points:
        raise UserError(
            f"the model reads {prior.prior.points} points of a marker's lane (task.model.priors.markers.prior.points), "
            f"and examples hold {markers.points} (data.example.markers.points): change either"
        )


def _check_points(model: HostConfig, config: ExampleConfig) -> None:
    for name, (points, why) in model.example_points.items():
        if (found := attrgetter(name)(config)) != points:
            raise UserError(
                f"the truth of this model needs data.example.{name}={points}, {why}, not {found}: change either"
            )


def _check_forms(model: HostConfig, config: ExampleConfig) -> None:
    for name, (form, why) in model.example_forms.items():
        if (found := attrgetter(name)(config)) != form:
            raise UserError(f"the truth of this model needs data.example.{name}={form}, not {found}: {why}")


def _check_history(model: HostConfig, config: ExampleConfig) -> None:
    traffic = model.priors.traffic_flow
    if traffic is not None and config.history < traffic.prior.frames:
        raise UserError(
            f"the model reads {traffic.prior.frames} past frames (task.model.priors.traffic_flow.prior.frames), and "
            f"examples hold {config.history} (data.example.history): change either"
        )
