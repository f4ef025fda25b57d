"""`tflane demo`: a small comparison on the built-in world, for two cores and ten minutes.

The same host is trained twice, on BEV evidence alone and with traffic flow. Both are evaluated on unseen scenes. A
single short run is no evidence: `tflane compare` trains several seeds and tests the difference.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tflane_jax.ablations.compare import compare
from tflane_jax.config import EvaluationConfig, RunConfig, WorldData
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

STEPS = 1400


def configs() -> dict[str, RunConfig]:
    """Return the demo's two configurations: the baseline and the same with traffic flow."""
    task = LaneGraphTask(losses=TopoNetLossConfig(successor_weight=20.0))
    baseline = RunConfig(
        task=task,
        data=WorldData(train=400, val=10, test=50),
        optim=OptimConfig(lr=1.5e-3, warmup_steps=100, b2=0.99, clip_norm=5.0, ema_decay=0.99),
        training=TrainingConfig(steps=STEPS, batch_size=4, log_every=25, eval_every=STEPS // 2, checkpoint_every=350),
        evaluation=EvaluationConfig(pictures=2),
    )
    with_traffic = LaneGraphTask(TopoNetConfig(priors=PriorsConfig(traffic_flow=TrafficFlowConfig())), task.losses)
    return {"baseline": baseline, "+TFM": replace(baseline, task=with_traffic)}


def main(out: Path) -> int:
    """Run the demo into a folder; finished runs in it are used."""
    print("Two trainings on the built-in world: lanes from BEV evidence alone, then with traffic flow (TF-Lane).")
    compare(configs(), (0,), out)
    print("\nA single short run is no evidence: `tflane compare` trains several seeds and tests the difference.")
    return 0
