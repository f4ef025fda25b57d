"""The task of lane graphs as the program around the training loop sees it."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.fakes import fake_prediction
from tests.models.cases import (
    BASELINE,
    CAMERA_TOPONET,
    LIFTED_LINES,
    SEGMENTS,
    WITH_TRAFFIC,
    make_example,
    make_line_example,
    make_segment_example,
)
from tests.parameters import random_params
from tests.priors.test_traffic_flow import make_flow
from tflane_jax.config import RunConfig, WorldData, load_config
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.errors import UserError
from tflane_jax.evaluation.lane_groups import LANE_GROUPS
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.camera_queries import LOST
from tflane_jax.limits import SettingError
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.map_lines import LineDecoderConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.raster_fusion import TrafficRasterConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.scene import Prediction, shapes_of, stack_examples
from tflane_jax.tasks import lane_graph
from tflane_jax.tasks.fit import check_augmentation
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.traffic import limit_instances, queries_only
from tflane_jax.world.bev.sensor import BevSensorConfig

WIDE = PerceptionRange((-60.0, 60.0), (-30.0, 30.0))
EXAMPLES = stack_examples([make_example()])
LANES_AND_AREAS = LaneSegNetConfig(decoder=replace(LaneSegNetConfig().decoder, classes=1), areas=AreaDecoderConfig())


def test_shipped_ranges_fit():
    RunConfig().task.check(WorldData(), EXAMPLES)


@pytest.mark.slow
def test_cells_beyond_a_capacity_are_counted():
    """Regression: nothing read the count; only the first training example was checked before the first step."""
    config = load_config("camera/toponet")
    model = replace(config.task.model, elements=None, denoising=None)
    encoder = replace(model.encoder, bev=replace(model.encoder.bev, layers=1))
    assert encoder.bev.capacity is not None
    task = LaneGraphTask(replace(model, encoder=encoder, decoder=replace(model.decoder, layers=1)))
    example = task.shapes(config.data)
    params = jax.eval_shape(task.init, jax.random.key(0), example)
    terms = jax.eval_shape(task.loss, params, shapes_of(example, 2), jax.random.key(0))[1]
    assert task.notices.keys() <= terms.keys()
    sown = {"encoder": {"layer_0": {"attention": {"camera_cells": (jnp.array(3),)}}}}
    sown["encoder"]["layer_1"] = {"attention": {"camera_cells": (jnp.array(1), jnp.array(4))}}
    assert lane_graph._lost({LOST: sown}) == {"lost/camera_cells": 4.0}
    assert lane_graph._lost({}) == {}


def test_a_raster_of_another_range_is_named():
    sensor = BevSensorConfig(grid=replace(BevGrid(), range=WIDE))
    data = WorldData(example=ExampleConfig(sensor=sensor))
    with pytest.raises(UserError, match=r"x \(-60\.0, 60\.0\).*task\.model\.encoder\.range"):
        LaneGraphTask(TopoNetConfig()).check(data, EXAMPLES)
    model = TopoNetConfig(encoder=replace(TopoNetConfig().encoder, range=WIDE))
    LaneGraphTask(model).check(data, EXAMPLES)


def test_a_raster_that_does_not_fold_is_named():
    model = replace(TopoNetConfig(), encoder=replace(TopoNetConfig().encoder, cell=3))
    named = r"100 x 200 cells \(data\.example\.sensor\.grid\).*blocks of 3 x 3 \(task\.model\.encoder\.cell\)"
    with pytest.raises(UserError, match=named):
        LaneGraphTask(model).check(WorldData(), EXAMPLES)


@pytest.mark.parametrize(
    ("model", "setting", "reason"),
    [
        (TopoNetConfig(), "lane_points", "as many as it predicts for a lane"),
        (BevFormerDetrConfig(encoder=EvidenceEncoderConfig(), elements=None), "lane_points", "as many as it predicts"),
        (LaneSegNetConfig(), "segment_points", "as many as it predicts for a segment"),
        (LaneSegNetConfig(), "area_points", "two sides of a crossing with 10 points each"),
        (LANES_AND_AREAS, "area_points", "as many as it predicts for an area"),
    ],
)
def test_truth_of_other_points_is_named(model, setting, reason):
    task, forms = LaneGraphTask(model), {name: value for name, (value, _) in model.example_forms.items()}
    task.check(WorldData(example=ExampleConfig(**forms)), EXAMPLES)
    with pytest.raises(UserError, match=rf"data\.example\.{setting}=\d+, {reason}.*not 7"):
        task.check(WorldData(example=ExampleConfig(**forms, **{setting: 7})), EXAMPLES)


def test_crossings_in_the_form_of_another_host_are_named():
    for model, own, other in ((LaneSegNetConfig(), "sides", "ring"), (LANES_AND_AREAS, "ring", "sides")):
        task = LaneGraphTask(model)
        task.check(WorldData(example=ExampleConfig(crossings=own)), EXAMPLES)
        with pytest.raises(UserError, match=rf"data\.example\.crossings={own}, not {other}: it learns a crossing as"):
            task.check(WorldData(example=ExampleConfig(crossings=other)), EXAMPLES)
    for form in ("ring", "sides"):  # TopoNet learns no crossings
        LaneGraphTask(TopoNetConfig()).check(WorldData(example=ExampleConfig(crossings=form)), EXAMPLES)


def test_a_class_of_lines_without_labels_is_named():
    examples = stack_examples([make_line_example()])
    four = LaneGraphTask(MapTrConfig(decoder=LineDecoderConfig(points=20, classes=4)))
    three = LaneGraphTask(MapTrConfig(decoder=LineDecoderConfig(points=20)))
    include, exclude = (
        WorldData(example=ExampleConfig(map_lines=MapLinesConfig(centerlines=form))) for form in ("include", "exclude")
    )
    four.check(include, examples)
    with pytest.raises(UserError, match=r"map_lines\.centerlines=include, not exclude: it learns four classes"):
        four.check(exclude, examples)
    for data in (include, exclude):  # more labels than classes do no harm
        three.check(data, examples)


def test_map_lines_of_other_points_or_none_at_all_are_named():
    task = LaneGraphTask(MapTrConfig(decoder=LineDecoderConfig(points=12)))
    examples = stack_examples([make_line_example()])
    with pytest.raises(UserError, match=r"set data\.example\.map_lines"):
        task.check(WorldData(), examples)
    with pytest.raises(UserError, match=r"data\.example\.map_lines\.points=12, .*not 20"):
        task.check(WorldData(example=ExampleConfig(map_lines=MapLinesConfig())), examples)
    task.check(WorldData(example=ExampleConfig(map_lines=MapLinesConfig(points=12))), examples)


def test_a_model_of_traffic_flow_needs_data_with_it():
    without = EXAMPLES.replace(traffic_flow=None)
    LaneGraphTask(BASELINE).check(WorldData(), without)
    task = LaneGraphTask(replace(TopoNetConfig(), priors=WITH_TRAFFIC.priors))
    task.check(WorldData(), EXAMPLES)
    with pytest.raises(UserError, match=r"data have none: .*data\.tracks"):
        task.check(WorldData(), without)
    limit_instances(task, 0).check(WorldData(), without)  # the matched control reads none
    with pytest.raises(UserError, match=r"reads 20 past frames .*hold 6 \(data\.example\.history\)"):
        task.check(WorldData(example=ExampleConfig(history=6)), EXAMPLES)


def test_a_marker_prior_needs_as_many_points_as_it_reads():
    task = LaneGraphTask(replace(TopoNetConfig(), priors=PriorsConfig(markers=MarkerFusionConfig())))
    task.check(WorldData(example=ExampleConfig(markers=MarkerConfig(points=12))), EXAMPLES)
    with pytest.raises(UserError, match=r"reads 11 points .*hold 7 \(data\.example\.markers\.points\)"):
        task.check(WorldData(example=ExampleConfig(markers=MarkerConfig(points=7))), EXAMPLES)


def test_truth_beyond_the_bev_features_is_named():
    data = WorldData(example=ExampleConfig(range=WIDE))
    with pytest.raises(UserError, match=r"data\.example\.range.*BEV features"):
        LaneGraphTask(TopoNetConfig()).check(data, EXAMPLES)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"decoder": replace(TopoNetConfig().decoder, output="metric")}, "lanes end"),
        ({"priors": PriorsConfig(traffic_flow=TrafficFlowConfig())}, "traffic flow ends"),
    ],
)
def test_truth_beyond_the_range_that_the_model_perceives_is_named(changes, what):
    model = replace(TopoNetConfig(), **changes)
    LaneGraphTask(model).check_settings(WorldData())
    near = replace(model, range=replace(model.range, x=(-30.0, 30.0)))
    with pytest.raises(UserError, match=rf"the model's {what} at x \(-30\.0, 30\.0\).*\(task\.model\.range\)"):
        LaneGraphTask(near).check_settings(WorldData())
    # Without either, the range has no effect.
    LaneGraphTask(replace(TopoNetConfig(), range=near.range)).check_settings(WorldData())


def test_traffic_beyond_the_bev_features_is_named():
    model = replace(TopoNetConfig(), priors=PriorsConfig(traffic_flow=TrafficFlowConfig()))
    far = replace(model, range=replace(model.range, x=(-80.0, 80.0)))
    with pytest.raises(UserError, match=r"traffic flow reaches to x \(-80\.0, 80\.0\).*BEV features"):
        LaneGraphTask(far).check_settings(WorldData())
    LaneGraphTask(replace(far, priors=PriorsConfig())).check_settings(WorldData())


def test_limiting_instances_needs_traffic_flow():
    with pytest.raises(UserError, match="baseline without traffic flow"):
        limit_instances(LaneGraphTask(BASELINE), 3)


@pytest.mark.slow
def test_the_matched_control_differs_from_the_treatment_by_the_traffic_alone():
    """The control of a comparison: the same parameters, no traffic in training and test."""
    treatment, example = LaneGraphTask(WITH_TRAFFIC), make_example()
    control = limit_instances(treatment, 0)
    shapes = [jax.eval_shape(task.init, jax.random.key(0), example) for task in (treatment, control)]
    assert shapes[0] == shapes[1]

    @jax.jit
    @partial(jax.grad, has_aux=True)
    def learn(params, example):
        points = control.predict(params, example).centerlines.points
        return (points**2).sum(), points

    params = random_params(treatment.init, example)
    gradient, points = learn(params, example)
    np.testing.assert_array_equal(points, learn(params, example.replace(traffic_flow=make_flow(7)))[1])
    # The layers that the module adds to the queries learn; what reads the traffic stays as it was.
    learning = {
        name: max(float(abs(leaf).max()) for leaf in jax.tree.leaves(part))
        for name, part in (gradient["spatial_encoder_0"] | {"temporal": gradient["temporal_encoder"]}).items()
    }
    assert learning.pop("temporal") == learning.pop("L_to_T") == 0.0
    assert all(learning.values())


@pytest.mark.slow
def test_queries_only_is_the_model_without_the_raster():
    traffic = WITH_TRAFFIC.priors.traffic_flow
    both = replace(
        WITH_TRAFFIC, priors=replace(WITH_TRAFFIC.priors, traffic_flow=replace(traffic, bev=TrafficRasterConfig()))
    )
    task, example = LaneGraphTask(both), make_example()
    assert queries_only(task) == LaneGraphTask(WITH_TRAFFIC)
    # The parameters of both fit: those of the raster are not used.
    params = random_params(task.init, example)
    points = [jax.jit(each.predict)(params, example).centerlines.points for each in (task, queries_only(task))]
    assert np.abs(points[0] - points[1]).max() > 0.01
    raster = replace(
        both, priors=replace(both.priors, traffic_flow=replace(both.priors.traffic_flow, insert="nowhere"))
    )
    for model in (BASELINE, raster):
        with pytest.raises(UserError, match="no traffic flow into its queries"):
            queries_only(LaneGraphTask(model))


def test_interventions_are_those_that_change_something():
    data, config = stack_examples([make_example(0), make_example(1)]), EvaluationConfig(batch_size=2)
    task = LaneGraphTask(WITH_TRAFFIC)
    assert {name: each.traffic for name, each in task.interventions(data, config).items()} == {
        "no traffic flow at inference": "none",
        "traffic of another scene": "other-scene",
    }
    for blind in (LaneGraphTask(BASELINE), limit_instances(task, 0)):
        assert blind.interventions(data, config) == {}
    assert task.interventions(data, replace(config, traffic="none")) == {}
    # Regression: with geometric topology there was none, without a word.
    geometric = task.interventions(data, replace(config, topology="geometric"))
    assert [(each.traffic, each.topology) for each in geometric.values()] == [
        ("none", "geometric"),
        ("other-scene", "geometric"),
    ]


def test_an_evaluation_that_examples_cannot_have_is_told_before_training():
    """Regression: it ended the run at its first evaluation, and no resumed run could pass that."""
    task, scene = LaneGraphTask(WITH_TRAFFIC), stack_examples([make_example(0)])
    task.check_evaluation(scene, EvaluationConfig(traffic="none"))
    with pytest.raises(UserError, match="at least two scenes"):
        task.check_evaluation(scene, EvaluationConfig(traffic="other-scene"))
    with pytest.raises(UserError, match="no traffic flow"):
        task.check_evaluation(scene.replace(traffic_flow=None), EvaluationConfig(traffic="none"))


def test_a_depth_network_refuses_images_of_other_sizes():
    """It gets the cameras' own intrinsics by one scale of all images."""
    check_augmentation(LIFTED_LINES, PhotometricConfig())
    check_augmentation(CAMERA_TOPONET, PhotometricConfig(scale=(0.8, 1.0)))
    with pytest.raises(SettingError, match=r"data\.augmentation\.scale"):
        check_augmentation(LIFTED_LINES, PhotometricConfig(scale=(0.8, 1.0)))


def test_an_evaluation_keeps_recall_as_counts_by_scene(monkeypatch):
    answer = jax.tree.map(jnp.asarray, Prediction(centerlines=fake_prediction()))
    monkeypatch.setattr(LaneGraphTask, "predict", lambda task, params, example: answer)
    config, task = EvaluationConfig(batch_size=2), LaneGraphTask(BASELINE)
    evaluation = task.evaluate({}, stack_examples([make_example()]), config)
    assert {f"{group}/recall" for group in ("all", *LANE_GROUPS)} < set(evaluation.ratios) < set(evaluation.scores())


@pytest.mark.parametrize(("areas", "kept"), [(None, 2), (AreaDecoderConfig(), 1)])
def test_a_frame_with_crossings_alone_is_empty_where_crossings_are_areas(areas, kept):
    """The rule of LaneSegNet's loader: rows of segments count, and crossings are such rows in one form only."""
    task = LaneGraphTask(replace(SEGMENTS, areas=areas), empty_frames="skip")
    frames = [make_segment_example(lanes=lanes, crossings=1 - bool(lanes)) for lanes in (0, 3)]
    frames.append(make_segment_example(lanes=0, crossings=0))
    assert len(task.examples(stack_examples(frames)).has_previous) == kept
