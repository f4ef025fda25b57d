"""What each masking variant of the traffic-flow module costs: the whole module, forward with gradient.

    python -m benchmarks.masking_variants --out runs/bench

The module (temporal and spatial encoder) of `configs/tf_lane/masking.py` on random tracks, for the number of lane
queries of the small host and of the papers. A variant's time includes making its mask from the distances between
lanes and tracks. Ratios are to the paper's masks (LT/LL), in one run. Beside them stand the scores of the trained
variants, where docs/results holds them (`tflane tables tf_lane.masking --record docs/results`). Table, JSON and picture
(cost beside score) are written to the folder.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import command_line, compile_jax, interleave, machine, markdown_table, save, summarise
from tflane_jax.ablations.paper.tf_lane import MASKING
from tflane_jax.config import load_ablations, load_config
from tflane_jax.files.fields import load_json
from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.prior import HostQueries, HostSpec
from tflane_jax.models.traffic_flow_module import SpatialEncoder, TemporalEncoder, TrafficFlowConfig
from tflane_jax.models.traffic_masks import spatial_mask
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.style import curve_style
from tflane_jax.plots.tables import written_to
from tflane_jax.priors.traffic_flow import SelectedTracks
from tflane_jax.tasks.lane_graph import LaneGraphTask

PAPER = "LT/LL"
QUERIES, BATCH, DIM, POINTS = (48, 200), 4, 64, 11
RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))
RECORDED = Path(__file__).parents[1] / f"docs/results/{MASKING.name}.json"
SCORES = ("all/DET_l", MASKING.primary)


def variants() -> dict[str, TrafficFlowConfig]:
    """Return the prior of each configuration of `configs/tf_lane/masking.py`, the paper's first."""
    configs = {PAPER: load_config("tf_lane/masking"), **load_ablations("tf_lane/masking")}
    found = {}
    for name, config in configs.items():
        assert isinstance(config.task, LaneGraphTask)
        found[name] = config.task.model.priors.traffic_flow
    return found


def make_inputs(queries: int, prior: TrafficFlowConfig) -> tuple[HostQueries, SelectedTracks]:
    """Return seeded random queries and tracks of a batch; about two thirds of the instances are valid."""
    rng = np.random.default_rng(queries)
    instances, frames = prior.prior.max_instances, prior.prior.frames
    features, position = (jnp.asarray(rng.standard_normal((BATCH, queries, DIM), np.float32)) for _ in range(2))
    asked = HostQueries(features, position, jnp.asarray(rng.random((BATCH, queries, POINTS, 3), np.float32)))
    valid = rng.random((BATCH, instances)) < 2 / 3
    heading = rng.standard_normal((BATCH, instances, frames, 2), np.float32)
    tracks = SelectedTracks(
        position=jnp.asarray(RANGE.denormalise(rng.random((BATCH, instances, frames, 3), np.float32))),
        heading=jnp.asarray(heading / np.linalg.norm(heading, axis=-1, keepdims=True)),
        size=jnp.asarray(rng.random((BATCH, instances, 3), np.float32)),
        category=jnp.zeros((BATCH, instances), jnp.int32),
        frame_valid=jnp.asarray(valid[..., None] & (rng.random((BATCH, instances, frames)) < 0.8)),
        valid=jnp.asarray(valid),
        weight=jnp.asarray(valid, jnp.float32),
        index=jnp.zeros((BATCH, instances), jnp.int32),
    )
    return asked, tracks


def program(config: TrafficFlowConfig, queries: HostQueries, tracks: SelectedTracks) -> tuple[Any, Any]:
    """Return the gradient of the module's squared output, and its parameters."""
    spec, module = HostSpec(DIM, RANGE, RANGE), config.module
    temporal = TemporalEncoder(module, DIM, spec.bev_range, config.prior.coordinates)
    spatial = SpatialEncoder(module, DIM)

    def one(params, asked: HostQueries, flow: SelectedTracks):
        tokens = temporal.apply(params["temporal"], flow)
        mask = spatial_mask(module.masking, asked, flow, spec.bev_range)
        return jnp.asarray(spatial.apply(params["spatial"], asked.features, asked.position, tokens, mask))

    def total(params, asked, flow):
        return (jax.vmap(one, (None, 0, 0))(params, asked, flow) ** 2).sum()

    asked, flow = jax.tree.map(lambda leaf: leaf[0], (queries, tracks))
    keys = jax.random.split(jax.random.key(0))
    start = {"temporal": jax.jit(temporal.init)(keys[0], flow)}
    tokens = temporal.apply(start["temporal"], flow)
    mask = spatial_mask(module.masking, asked, flow, spec.bev_range)
    start["spatial"] = jax.jit(spatial.init)(keys[1], asked.features, asked.position, tokens, mask)
    return jax.grad(total), start


def trained_scores(file: Path = RECORDED) -> dict[str, dict[str, str]]:
    """Return `SCORES` of each trained variant at its last checkpoint, in percent; nothing where none is recorded.

    Args:
        file: summary of the table `tf_lane.masking`.
    """
    if not file.exists():
        return {}
    recorded = {row["model"]: row for row in load_json(file)["rows"] if row["checkpoint"] == "last"}
    names = {MASKING.claims[0].control: PAPER}
    names |= {
        row.name: row.config.partition(":")[2] for row in MASKING.rows if row.config.startswith("tf_lane/masking:")
    }
    return {name: {s: recorded[row][s] for s in SCORES} for row, name in names.items() if row in recorded}


def speed_and_scores(
    timings: Mapping[str, Mapping[str, Mapping[str, float]]], scores: Mapping[str, Mapping[str, str]]
) -> str:
    """Return a row for each variant: its time for each number of queries, and its scores where it was trained.

    Args:
        timings: of `timing.summarise`, by number of queries and variant.
        scores: of `trained_scores`.
    """
    columns = SCORES if scores else ()
    rows = []
    for name in next(iter(timings.values())):
        of_variant = [by_name[name] for by_name in timings.values()]
        times = [f"{c['median_ms']:.2f} ms" if name == PAPER else f"{c['ratio']:.2f}" for c in of_variant]
        rows.append([name, *times, *(scores.get(name, {}).get(score, "-") for score in columns)])
    return markdown_table(["masks", *(f"{count} queries" for count in timings), *columns], rows)


def save_picture(
    path: Path, timings: Mapping[str, Mapping[str, Mapping[str, float]]], scores: Mapping[str, Mapping[str, str]]
) -> Path:
    """Draw the cost of each variant and, where it was trained, its scores; return the path.

    Args:
        path: .png, .pdf or .svg.
        timings, scores: as for `speed_and_scores`.
    """
    names = list(next(iter(timings.values())))
    places, shown = np.arange(len(names)), SCORES if scores else ()
    figure, axes = new_figure(1, 1 + len(shown), panel=(3.4, 0.9 + 0.24 * len(names)), footer=0.3)
    cost, height = axes[0, 0], 0.8 / len(timings)
    for number, (count, by_name) in enumerate(timings.items()):
        ratios = [by_name[name]["ratio"] for name in names]
        offset = height * (number - 0.5 * (len(timings) - 1))
        cost.barh(places + offset, ratios, height, color=curve_style(number)["color"], label=f"{count} queries")
    cost.axvline(1.0, color="black", lw=0.9, ls="--")
    cost.set_title(f"time of the module ({PAPER}: the paper's masks)", fontsize=9, loc="left")
    cost.set_xlabel(f"multiple of {PAPER}", fontsize=8)
    figure.legend(handles=cost.containers, loc="outside lower left", ncols=len(timings), fontsize=8, frameon=False)
    for ax, score in zip(axes[0, 1:], shown, strict=True):
        found = {i: scores[name][score].split(" ± ") for i, name in enumerate(names) if name in scores}
        means = [float(mean) for mean, *_ in found.values()]
        spread = [float(one[1]) if len(one) > 1 else 0.0 for one in found.values()]
        ax.errorbar(means, list(found), xerr=spread, fmt="o", ms=4, lw=1.2, capsize=2.5, color=curve_style(0)["color"])
        ax.set_title(score, fontsize=9, loc="left")
        ax.set_xlabel("percent, mean ± standard deviation over seeds", fontsize=8)
    for ax in axes.flat:
        ax.set_yticks(places, names if ax is cost else [""] * len(names))
        ax.set_ylim(len(names) - 0.5, -0.5)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3, lw=0.5)
        ax.set_axisbelow(True)
    return save_figure(figure, path)


def run(out: Path, *, queries: tuple[int, ...] = QUERIES, seconds: float = 8.0) -> dict[str, Any]:
    """Run the benchmark, print its table and write `masking_variants.json`, `.md` and `.png`; return the record.

    Args:
        out: folder.
        queries: numbers of lane queries.
        seconds: at least that long for each number of queries.
    """
    record: dict[str, Any] = {"batch": BATCH, "channels": DIM, "queries": {}}
    for count in queries:
        compiled = {}
        for name, config in variants().items():
            inputs = make_inputs(count, config)
            gradient, params = program(config, *inputs)
            compiled[name] = compile_jax(gradient, params, *inputs)
        timings = summarise(interleave({name: c.program for name, c in compiled.items()}, seconds), PAPER)
        record["queries"][str(count)] = timings
    record = machine() | record | {"scores": trained_scores()}  # the load is that at the end
    text = speed_and_scores(record["queries"], record["scores"])
    print(text)
    save(out, "masking_variants", record, text)
    written = [out / "masking_variants.md"]
    if importlib.util.find_spec("matplotlib") is not None:
        written.append(save_picture(out / "masking_variants.png", record["queries"], record["scores"]))
    print(f"\n{written_to(written)}")
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=8.0)
    parser.add_argument("--queries", type=int, nargs="+", default=QUERIES, help="numbers of lane queries")
    options = parser.parse_args()
    run(options.out, queries=tuple(options.queries), seconds=options.seconds)


if __name__ == "__main__":
    main()
