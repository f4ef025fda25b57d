"""A tiny model, examples that are made up, and a model that compiles in no time: for tests of commands and of runs."""

import jax
import jax.numpy as jnp
import pytest

from tests.fakes import FakeConfig, FakeDataset, fake_elements, fake_prediction
from tflane_jax.scene import Prediction
from tflane_jax.tasks.lane_graph import LaneGraphTask

CONFIG = '''"""A tiny model for the tests of the command line."""

from dataclasses import replace

from tflane_jax.config import EvaluationConfig, RunConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig


def get_config():
    return RunConfig(
        task=LaneGraphTask(TopoNetConfig(priors=PriorsConfig(traffic_flow=TrafficFlowConfig(TrafficFlowPriorConfig(max_instances=4))))),
        optim=OptimConfig(lr=0.01, warmup_steps=1),
        training=TrainingConfig(steps=4, batch_size=2, log_every=2, eval_every=2, checkpoint_every=2),
        evaluation=EvaluationConfig(batch_size=2, pictures=1),
    )


def ablations():
    return {"baseline": replace(get_config(), task=LaneGraphTask())}
'''

# Matplotlib takes most of the time of a training as short as these; one test looks at the pictures.
FEW_PICTURES = ["--training.eval-every", "4", "--evaluation.pictures", "0"]


def use_fakes(patch):
    """Give fake examples, and instead of the model one that moves a fixed prediction: it compiles in no time."""

    def open_fake(source, *, progress=True):
        return FakeDataset(FakeConfig(5))

    def init(task, key, example):
        return {"shift": {"kernel": jax.random.normal(key, (1, 3))}}

    def loss(task, params, batch, key):
        points = (params["shift"]["kernel"] ** 2).mean() + batch.lanes.valid.mean()
        return points, {"points": points}

    def predict(task, params, example):
        prediction = jax.tree.map(jnp.asarray, fake_prediction(0))
        lanes = prediction.replace(points=prediction.points + params["shift"]["kernel"][None])
        return Prediction(centerlines=lanes, elements=jax.tree.map(jnp.asarray, fake_elements()))

    for function in (init, loss, predict):
        patch.setattr(LaneGraphTask, function.__name__, function)
    patch.setattr("tflane_jax.datasets.sources.open_dataset", open_fake)


@pytest.fixture(scope="module", autouse=True)
def fakes():
    with pytest.MonkeyPatch.context() as patch:
        use_fakes(patch)
        yield
