"""Variants of a trained lane-graph task that use less of the traffic flow."""

from __future__ import annotations

from tflane_jax.config_io import with_setting
from tflane_jax.errors import UserError
from tflane_jax.tasks.lane_graph import LaneGraphTask


def limit_instances(task: LaneGraphTask, count: int) -> LaneGraphTask:
    """Return the task with at most `count` instances of traffic flow, those with the largest weights; 0 removes it.

    Parameters stay the same. Raises UserError if the model takes no traffic flow or has fewer slots.
    """
    traffic = task.model.priors.traffic_flow
    if traffic is None:
        raise UserError("this run is a baseline without traffic flow: --max-instances has nothing to limit")
    if not 0 <= count <= traffic.prior.max_instances:
        raise UserError(f"--max-instances {count} is outside 0 to {traffic.prior.max_instances}, the model's slots")
    return with_setting(task, "model.priors.traffic_flow.prior.top_instances", count)


def queries_only(task: LaneGraphTask) -> LaneGraphTask:
    """Return the task with traffic flow in the lane queries alone: BEV features get none.

    Parameters stay the same; those of the fusion into BEV features are not used. Raises UserError if the model takes
    no traffic flow, or takes it in BEV features only.
    """
    traffic = task.model.priors.traffic_flow
    if traffic is None or traffic.insert == "nowhere":
        raise UserError("this model takes no traffic flow into its queries (task.model.priors.traffic_flow.insert)")
    return with_setting(task, "model.priors.traffic_flow.bev", None)
