"""Beside the papers' tables: what makes a small TopoNet learn within minutes (docs/small_models.md), part by part."""

from __future__ import annotations

from tflane_jax.ablations.declaration import Claim
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow

_WITHOUT = {
    "sigmoid output": "sigmoid",
    "no proposals": "learned_queries",
    "no context": "without_context",
    "no denoising": "without_denoising",
    "class target 1": "class_one",
    "Muon on dense kernels only": "muon_dense",
    "Adam": "adam",
    "published forms": "published",
}

TABLES = (
    PaperTable(
        name="small_host.1",
        title="the small TopoNet, and the same without one part each",
        rows=(
            TableRow("recipe", "tf_lane/toponet:street"),
            *(TableRow(name, f"tf_lane/toponet:street_{ablation}") for name, ablation in _WITHOUT.items()),
        ),
        claims=tuple(Claim("recipe", name) for name in _WITHOUT),
        primary="all/DET_l",
        columns=("all/DET_l", "all/TOP_ll", "all/recall"),
        quoted=Quoted("no table of a paper", ()),
        seeds=3,
        steps=2500,
        minutes=5.0,
    ),
)
