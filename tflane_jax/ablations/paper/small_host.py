"""Beside the papers' tables: what makes a small TopoNet learn within minutes (docs/small_models.md), part by part.

The first two were declared when lane proposals belonged to the recipe on `street`. The first showed that the host
learns faster without them there, and the configurations followed; the second is the experiment `tf_lane.2` with
proposals. The last row of the first was declared as "published forms", which it is not; the third table has them.
"""

from __future__ import annotations

from dataclasses import replace

from tflane_jax.ablations.declaration import Claim
from tflane_jax.ablations.paper import tf_lane
from tflane_jax.ablations.paper.table import PaperTable, Quoted, RateSearch, TableRow

_PROPOSALS = ("--task.model.decoder.proposals", "default", "--task.model.decoder.proposals.count", "36")
_WITHOUT = {
    "sigmoid output": "sigmoid",
    "no context": "without_context",
    "no denoising": "without_denoising",
    "class target 1": "class_one",
    "Muon on dense kernels only": "muon_dense",
    "Adam": "adam",
}
_ROWS = (
    TableRow("recipe", "tf_lane/toponet:street", _PROPOSALS),
    *(TableRow(name, f"tf_lane/toponet:street_{part}", _PROPOSALS) for name, part in _WITHOUT.items()),
    TableRow("no proposals", "tf_lane/toponet:street"),
    TableRow("most published forms", "tf_lane/toponet:street_plain"),
)
_MOST = (
    "*most published forms*: sigmoid output, three layers, learned queries, no context, no denoising, Adam; refinement,"
    " class target and weight of the topology are the recipe's. Declared as *published forms*."
)
_PUBLISHED = "published forms"
# The best of the table's search (docs/small_models.md).
_PUBLISHED_RATE = ("--optim.lr", "5e-4")

(_TRAFFIC_FLOW,) = (table for table in tf_lane.TABLES if table.name == "tf_lane.2")

TABLES = (
    PaperTable(
        name="small_host.1",
        title="the small TopoNet with lane proposals, and the same without one part each",
        rows=_ROWS,
        claims=tuple(Claim("recipe", row.name) for row in _ROWS[1:]),
        primary="all/DET_l",
        columns=("all/DET_l", "all/TOP_ll", "all/recall"),
        quoted=Quoted("no table of a paper", ()),
        note=_MOST,
        seeds=3,
        steps=2500,
        minutes=10.0,
    ),
    replace(
        _TRAFFIC_FLOW,
        name="small_host.2",
        title="TopoNet with lane proposals, without and with traffic flow",
        minutes=11.0,
        rows=tuple(replace(row, settings=_PROPOSALS) for row in _TRAFFIC_FLOW.rows),
    ),
    PaperTable(
        name="small_host.3",
        title="the small TopoNet in its published forms, and by the recipe",
        rows=(
            TableRow(_PUBLISHED, "tf_lane/toponet:street_published", _PUBLISHED_RATE),
            TableRow("recipe", "tf_lane/toponet:street"),
        ),
        claims=(Claim("recipe", _PUBLISHED),),
        primary="all/DET_l",
        columns=("all/DET_l", "all/TOP_ll", "all/recall"),
        quoted=Quoted("no table of a paper", ()),
        seeds=3,
        steps=2500,
        minutes=3.8,
        search=RateSearch((_PUBLISHED,), (1.7e-4, 5e-4, 1.5e-3, 4.5e-3), "all/DET_l"),
    ),
)
