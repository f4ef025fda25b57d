"""A camera model with markers on rendered drives, from pixels to lanes: scores with its boards and without them.

    python -m benchmarks.marker_scenes --model RUN [--without RUN] --out runs/marker_scenes    # twenty scenes
    python -m benchmarks.marker_scenes --tiny --scenes 1 --out runs/marker_scenes

Native images of scenes of the test split are searched for boards as a whole, as `tflane markers run` does; store,
residual, confidence, memory and model follow. Every frame is computed a second time by the functions of each part, and
must be the same. "boards withheld" is the same model without detections, `--without` another one, such as the host
tuned without markers. Frames are "seen" (a board of the store was read), "gap" (none now, one before) or "before".

Written are the scores, what the boards change in recall with intervals over scenes, the CPU time by part, and two
pictures: the confidence of each frame, and gaps, with the last image that shows the board, the truth, the lanes in
memory and those of each model.

`--tiny` takes random weights and one decoder layer and shows that everything runs; its scores mean nothing. A model
whose scores mean something is a run of `markers/camera_clips:pixels` from a host of `markers/camera_host`
(docs/markers.md).

`--tiny` takes 12 CPU seconds to start, 20 for the first frame and 1.6 for each other one, 1.2 of them to draw six
native images: some 5 CPU minutes for twenty scenes of 8 frames, with boards searched by their outlines, as that
configuration does.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from benchmarks.marker_scene_pictures import Cell, Gap, Sighting, save_confidence, save_gaps, sighting
from benchmarks.marker_scene_scores import differences, differences_table, scores_table
from benchmarks.timing import command_line, machine, save
from tflane_jax.config import load_config
from tflane_jax.datasets.marker_cache import search_views
from tflane_jax.datasets.marker_observations import store_of_log
from tflane_jax.datasets.native_views import fitted_views
from tflane_jax.datasets.openlane_example import blank
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.errors import UserError
from tflane_jax.evaluation.lane_graph import LaneGraphMetrics, Sightings
from tflane_jax.geometry import relative_pose
from tflane_jax.markers.detection import DetectedMarkers, locate
from tflane_jax.markers.image_search import ImageMarkers
from tflane_jax.markers.observe import observe
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.markers.reader import MarkerReader, ReaderConfig
from tflane_jax.markers.store import MarkerStore
from tflane_jax.models.marker_fusion import MarkerPrior, as_fused
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.run_checks import shapes_of_params
from tflane_jax.runs import open_run
from tflane_jax.scene import CameraViews, Example, MarkerObservations, Prediction
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.marker_drive import DriveModel, DriveStep, MarkerDrive, as_trained, check_model
from tflane_jax.training.runtime import configure_jax
from tflane_jax.world.cameras.sensor import render_cameras

CONFIG = "markers/camera_clips:pixels"
WITH, WITHHELD, WITHOUT = "markers", "boards withheld", "model without markers"


class Frame(NamedTuple):
    """A frame of a rendered drive.

    Attributes:
        scene: number among the scenes that are driven.
        moment: time and pose.
        views: native images.
        truth: the example of the dataset, without markers.
        store: of the scene's boards.
    """

    scene: int
    moment: KeyFrame
    views: CameraViews
    truth: Example
    store: MarkerStore


def frames(source: ProceduralConfig, pixels: PixelConfig) -> Iterator[Frame]:
    """Yield the frames of the source's scenes in order, with native images of its own cameras."""
    markers = source.example.markers
    assert markers is not None
    dataset = ProceduralDataset(replace(source, example=replace(source.example, markers=None)))
    rig, bikes = pixels.native(source.example.cameras), source.example.bike_lanes == "include"
    for scene, log in enumerate(dataset.drives()):
        store = store_of_log(log, radius=markers.radius, bike_lanes=bikes)
        for number, moment in enumerate(log.keyframes):
            truth = dataset.example(scene * len(log.keyframes) + number)
            yield Frame(scene, moment, _rendered(log, number, rig), truth, store)


def _rendered(log: Log, keyframe: int, rig: Any) -> CameraViews:
    return render_cameras(log, keyframe, rig).replace(depth=None, depth_valid=None)  # pyright: ignore


class Clock:
    """CPU seconds of a drive, by part.

    Attributes:
        frames: seconds of each frame by the name of the part. The first frame compiles.
    """

    def __init__(self) -> None:
        self.frames: list[dict[str, float]] = []
        self._last = time.process_time()

    def next_frame(self) -> None:
        """Begin a frame."""
        self.frames.append({})

    def lap(self, part: str) -> None:
        """Count the time since the last lap for a part of this frame."""
        now = time.process_time()
        self.frames[-1][part] = self.frames[-1].get(part, 0.0) + now - self._last
        self._last = now

    def __str__(self) -> str:
        first, later = self.frames[0], self.frames[1:] or self.frames
        parts = {name: np.mean([frame.get(name, 0.0) for frame in later]) for name in later[0]}
        each_part = ", ".join(f"{name} {seconds:.1f}" for name, seconds in parts.items())
        each = f"CPU seconds of a frame: {sum(parts.values()):.1f} ({each_part})"
        return f"{each}; of the first one, which compiles: {sum(first.values()):.0f}"


class Parts:
    """The priors of a drive, put together from the functions of each part, beside `MarkerDrive`."""

    def __init__(self, model: DriveModel, config: ReaderConfig):
        self.model, self.config = model, config
        markers = model.task.model.priors.markers
        assert markers is not None
        self._prior = MarkerPrior(markers, model.task.model.spec)
        self._observe = jax.jit(self._prior.observe)
        self.restart()

    def restart(self) -> None:
        """Begin another scene."""
        self._before: tuple[KeyFrame, DetectedMarkers] | None = None
        self._bank = self._prior.start() if self.model.task.streams else None

    def frame(self, frame: Frame, searched: Sequence[ImageMarkers]) -> tuple[Example, MarkerGuidance]:
        """Return what the model reads, and the lanes after gate and memory."""
        config, before, moment = self.config, self._before, frame.moment
        last = moment if before is None else before[0]
        detected = locate(frame.views, searched, config.detector, frame.store.sizes)
        observed = observe(
            detected,
            frame.store,
            config.range,
            markers=config.markers,
            lanes=config.lanes,
            points=config.points,
            previous=None if before is None else before[1],
            now_from_previous=None if before is None else relative_pose(moment.global_from_ego, last.global_from_ego),
            first_residual=config.first_residual,
        ).markers
        example = replace(
            blank(self.model.source.example, governed="lanes", views=None, traffic=True),
            markers=observed,
            previous_from_ego=relative_pose(last.global_from_ego, moment.global_from_ego).astype(np.float32),
            has_previous=np.asarray(before is not None),
        )
        guidance, self._bank = self._observe(example, self._bank)
        guidance = as_fused(guidance, self._prior.config)
        self._before = moment, detected
        return replace(example, cameras=fitted_views(frame.views, self.model.source)), jax.device_get(guidance)


class Stream:
    """A model with its memory, frame by frame; one that was trained on single frames has none."""

    def __init__(self, model: DriveModel, step: Any):
        self._model, self._step = model, step
        self.restart()

    def restart(self) -> None:
        """Begin another scene."""
        self._memory = self._model.task.start() if self._model.task.streams else None

    def answer(self, example: Example) -> Prediction:
        """Return the prediction for the next frame."""
        following, found = self._step(self._model.params, self._memory, example)
        self._memory = following if self._model.task.streams else None
        return jax.device_get(found)


def _check(step: DriveStep, example: Example, guidance: MarkerGuidance, answer: Prediction) -> None:
    """Raise AssertionError where the drive is not the composition of its parts, bit by bit."""
    whole = step.reading.observed.markers, step.guidance, step.prediction
    jax.tree.map(np.testing.assert_array_equal, whole, (example.markers, guidance, answer))


def measure(
    source: ProceduralConfig, model: DriveModel, other: DriveModel | None, out: Path, clock: Clock
) -> tuple[dict[str, LaneGraphMetrics], dict[str, int]]:
    """Drive through the scenes, draw pictures, and return the metrics of each model and the frames of each group."""
    markers = source.example.markers
    if markers is None or model.task.model.priors.markers is None or source.example.cameras is None:
        raise UserError(f"this model reads no markers in images: take a run of {CONFIG}")
    pixels = markers.pixels or PixelConfig()
    config = as_trained(ReaderConfig(pixels.detector, source.example.range), model)
    program, parts, drive = jax.jit(model.task.step), Parts(model, config), None
    streams = {WITH: Stream(model, program), WITHHELD: Stream(model, program)}
    if other is not None:
        streams[WITHOUT] = Stream(other, jax.jit(other.task.step))
    metrics = {name: LaneGraphMetrics(frame_groups=Sightings.groups) for name in streams}
    sightings, count, scene = Sightings(), dict.fromkeys(Sightings.groups, 0), 0
    gaps: list[Gap] = []
    cells: list[Cell] = []
    latest: Sighting | None = None
    nothing = MarkerObservations.empty(config.markers, config.lanes, config.points)
    total = source.scenes * source.world.keyframes
    for frame in tqdm(frames(source, pixels), desc="drive", unit="frame", total=total):
        reader = MarkerReader(frame.store, config)
        if drive is None:
            drive = MarkerDrive(reader, model)
        elif frame.scene != scene:
            for each in (parts, *streams.values()):
                each.restart()
            drive.restart(reader)
            latest = None
        scene, moment = frame.scene, frame.moment
        clock.next_frame()
        clock.lap("images")
        searched = search_views(frame.views, config.detector)
        clock.lap("search")
        step = drive.step(frame.views, moment.timestamp_ns, moment.global_from_ego, searched)
        example, guidance = parts.frame(frame, searched)
        seen = {name: example if name == WITH else replace(example, markers=nothing) for name in streams}
        found = {name: stream.answer(seen[name]) for name, stream in streams.items()}
        _check(step, example, guidance, found[WITH])
        clock.lap("models, twice")
        group = sightings.next(step.reading.observed.markers.valid.any(), frame.truth.has_previous)
        count[group] += 1
        for name, metric in metrics.items():
            metric.update(found[name], frame.truth, [group])
        clock.lap("scores")
        latest = sighting(frame.views, moment, step) or latest
        cells.append(Cell(scene, group, float(guidance.gate)))
        if group == "gap" and guidance.valid.any() and latest is not None:
            gaps.append(Gap(scene, moment, latest, frame.truth, guidance, found))
    assert drive is not None
    print("\nwritten to", save_confidence(out / "marker_scenes_confidence.png", cells, drive.interval))
    picture = save_gaps(out / "marker_scenes_gaps.png", gaps, source)
    print("no picture of gaps: no board was seen and then lost" if picture is None else f"written to {picture}")
    return metrics, count


def tiny(scenes: int) -> DriveModel:
    """Return a model of random weights with one decoder layer, which compiles sooner; no part of it is silent."""
    config = load_config(CONFIG)
    assert isinstance(config.task, LaneGraphTask)
    model = config.task.model
    assert isinstance(model, TopoNetConfig)
    assert model.elements is not None
    model = replace(model, decoder=replace(model.decoder, layers=1), elements=replace(model.elements, layers=1))
    task = replace(config.task, model=model)
    shapes = shapes_of_params(task, task.shapes(config.data))
    source = config.data.source("test")
    assert isinstance(source, ProceduralConfig)
    return DriveModel(task, jax.tree.map_with_path(_random, shapes), replace(source, scenes=scenes))


def _random(path: tuple[Any, ...], leaf: Any) -> np.ndarray:
    """Return weights that keep the size of their input."""
    name = jax.tree_util.keystr(path)
    if name.endswith(("['scale']", "['var']")):
        return np.ones(leaf.shape, leaf.dtype)
    spread = 0.02 if len(leaf.shape) < 2 else np.prod(leaf.shape[:-1]) ** -0.5
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    return (spread * rng.standard_normal(leaf.shape)).astype(leaf.dtype)


def opened(folder: Path, scenes: int) -> DriveModel:
    """Return a trained model with the first scenes of its test split."""
    trained = open_run(folder)
    source = trained.config.data.source("test")
    if not isinstance(source, ProceduralConfig):
        raise UserError(f"{folder} was not trained on the built-in world: take a run of {CONFIG}")
    return DriveModel(check_model(trained.config.task), trained.params[0], replace(source, scenes=scenes))


def run(out: Path, folder: Path | None, without: Path | None = None, scenes: int = 20) -> dict[str, Any]:
    """Print and write table and pictures of a run, of random weights without one; return the record."""
    model = tiny(scenes) if folder is None else opened(folder, scenes)
    clock = Clock()
    measured, count = measure(model.source, model, None if without is None else opened(without, scenes), out, clock)
    scores = {name: metric.compute() for name, metric in measured.items()}
    above = differences({name: metric.ratios() for name, metric in measured.items()}, WITH)
    table = f"{scores_table(scores, count)}\n\n{differences_table(above)}"
    print(f"\n{scenes} scenes, scores of OpenLane-V2 v2.1; every frame equals the composition of its parts\n\n{table}")
    print(f"\n{clock}")
    record = {"machine": machine(), "model": None if folder is None else str(folder), "scenes": scenes}
    record |= {"frames": count, "scores": scores, "recall differences": above, "cpu_seconds": clock.frames}
    save(out, "marker_scenes", record, f"{table}\n\n{clock}")
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, scenes=20)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--model", type=Path, help="run folder of a camera model with markers")
    which.add_argument("--tiny", action="store_true", help="random weights, to see that everything runs")
    parser.add_argument("--without", type=Path, help="run folder of a model without markers")
    options = parser.parse_args()
    configure_jax()
    run(options.out, options.model, options.without, options.scenes)


if __name__ == "__main__":
    main()
