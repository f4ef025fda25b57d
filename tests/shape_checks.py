"""Checks the shapes in the signatures of all hosts, by tracing them; run as a program (`tests/test_shapes.py`).

An import hook adds the checks, so that the modules must not have been imported before.
"""

import sys
from dataclasses import replace

import jax
from jaxtyping import install_import_hook

import tests.typechecker  # noqa: F401 (the hook takes it from there)

CHECKED = [f"tflane_jax.{part}" for part in ("geometry", "layers", "losses", "matching", "models", "priors")]


def main(hosts: list[str]) -> None:
    """Trace initialisation, loss and prediction of the hosts.

    The first shape that is not as annotated, or number whose type is promoted, ends it.
    """
    with install_import_hook(CHECKED, "tests.typechecker.check"):
        from tests.models import cases, images, test_lanesegnet, test_padding
        from tests.tasks import test_lane_shape
        from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
        from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
        from tflane_jax.losses.maptr import MapTrLossConfig
        from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
        from tflane_jax.scene import stack_examples
        from tflane_jax.tasks.lane_graph import LaneGraphTask

    camera, bucket = cases.make_camera_example(), LaneGraphTask(test_lanesegnet.BUCKET, LaneSegNetLossConfig())
    tasks = {
        "toponet": (LaneGraphTask(cases.WITH_TRAFFIC), cases.make_example()),
        "toponet, cameras": (LaneGraphTask(cases.CAMERA_TOPONET), camera),
        "toponet, every prior": (
            LaneGraphTask(replace(cases.CAMERA_TOPONET, priors=test_padding.PRIORS, denoising=test_padding.NOISE)),
            test_padding.with_priors(camera),
        ),
        "lanesegnet": (LaneGraphTask(cases.SMALL_SEGMENTS, LaneSegNetLossConfig()), cases.make_segment_example()),
        "lanesegnet, areas": (bucket, cases.make_segment_example()),
        "maptr": (LaneGraphTask(cases.SMALL_LINES, MapTrLossConfig()), cases.make_line_example()),
        "maptrv2": (LaneGraphTask(cases.LIFTED_LINES, MapTrV2LossConfig()), cases.make_depth_example(0)),
        "bevformer_detr": (LaneGraphTask(cases.CAMERA_DETR, BevFormerDetrLossConfig()), camera),
        **{
            name: (images.tiny_task(encoder), images.road_image(0))
            for name, encoder in test_lane_shape.ENCODERS.items()
        },
    }
    for name in hosts or tasks:
        task, example = tasks[name]
        params = jax.eval_shape(task.init, jax.random.key(0), example)
        with jax.numpy_dtype_promotion("strict"):
            jax.eval_shape(task.loss, params, stack_examples([example, example]), jax.random.key(0))
            jax.eval_shape(task.predict, params, example)
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])
