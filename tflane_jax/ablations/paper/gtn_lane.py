"""The GTN paper's table, on front views of the built-in world: its encoder beside others in the same model."""

from __future__ import annotations

from tflane_jax.ablations.declaration import Claim
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow

TABLES = (
    PaperTable(
        name="gtn_lane.1",
        title="the GTN encoder beside LSTR's transformer and other graph networks",
        rows=(
            TableRow("transformer (LSTR)", "gtn_lane/transformer"),
            TableRow("GTN", "gtn_lane/gtn"),
            TableRow("GCN", "gtn_lane/gcn"),
            TableRow("HAN", "gtn_lane/han"),
        ),
        claims=(
            Claim("GTN", "transformer (LSTR)", "ours: the paper compares with other systems, not with this encoder"),
            Claim("GTN", "GCN", "ours: learnt edge types are better than given ones"),
            Claim("GTN", "HAN", "ours: learnt meta-paths are better than attention over single relations"),
        ),
        primary="all/Accuracy",
        columns=("all/Accuracy", "all/FP", "all/FN"),
        quoted=Quoted(
            "TuSimple, test split; TuSimple's metric (accuracy in percent), frames per second on a GPU not named",
            (
                {"model": "SCNN", "fps": 7, "FP": 0.0617, "FN": 0.0180, "Accuracy": 96.53},
                {"model": "PINet", "fps": 30, "FP": 0.0294, "FN": 0.0263, "Accuracy": 96.70},
                {"model": "FastDraw", "fps": 90, "FP": 0.0760, "FN": 0.0450, "Accuracy": 95.20},
                {"model": "GTN (the paper's)", "fps": 420, "FP": 0.0293, "FN": 0.0402, "Accuracy": 96.21},
            ),
        ),
        seeds=5,
        minutes=11.0,
    ),
)
