"""TF-Lane's tables (Xie, Xia, Yang), on the built-in world with BEV evidence: preset `street`, for Table 6 `city`.

Tables 1 to 4 test whether traffic flow helps where it can: the primary measure is recall on lanes with little evidence
that vehicles drove along, the negative control recall on lanes with little evidence and no vehicle near. The secondary
measure is the one in which the paper states its gain, as far as BEV evidence has it: mAP, and DET_l for TopoNet, whose
OLS needs traffic elements. `LONG` repeats the module of Table 2 with longer trainings. Tables 5 to 7 are the paper's
ablations on LaneSegNet and are decided by its mAP.
"""

from __future__ import annotations

from functools import partial

from tflane_jax.ablations.declaration import Claim, Reported
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow, claim
from tflane_jax.evaluation.interventions import NO_TRAFFIC

_OPENLANE = "OpenLane-V2 subset A, validation split; 60 epochs, * best epoch of the baseline and of ours"
_NUSCENES = "nuScenes, validation split, Chamfer AP in percent; 60 epochs, * best epoch"
_LANESEGNET = f"{_OPENLANE}; LaneSegNet's metrics, percent; AP_ped is printed AP_pred"
_GROUPS = ("hidden+traffic/recall", "hidden-traffic/recall")
_WITHOUT = f"LaneSegNet + TFM, {NO_TRAFFIC}"
_gain = partial(Reported, measure="mAP", decimals=2)
_SEGMENTS = ("all/mAP", "all/AP_ls", "all/AP_ped", "all/TOP_lsls")
_LINES = ("lines/mAP", "lines/AP_divider", "lines/AP_ped_crossing", "lines/AP_boundary")


def _quoted(source: str, columns: tuple[str, ...], **rows: tuple[str | float, ...]) -> Quoted:
    cells = ({"model": name} | dict(zip(columns, numbers, strict=True)) for name, numbers in rows.items())
    return Quoted(source, tuple(cells))


def _with_and_without(
    number: int,
    title: str,
    host: str,
    label: str,
    primary: tuple[str, str],
    columns: tuple[str, ...],
    secondary: str,
    steps: int,
    minutes: float,
    quoted: Quoted,
    papers: tuple[str, *tuple[Reported, ...]],
    note: str = "",
) -> PaperTable:
    """Return the table of one host: without and with the TFM, each traffic reading, and the controls."""
    tfm = f"{label} + TFM"
    bev = f"{tfm} + BEV"
    return PaperTable(
        name=f"tf_lane.{number}",
        title=title,
        rows=(
            TableRow(label, f"tf_lane/{host}:street"),
            TableRow(tfm, f"tf_lane/{host}_tfm:street"),
            TableRow(f"{tfm}, control", f"tf_lane/{host}_tfm:street_control"),
            TableRow(bev, f"tf_lane/{host}_tfm:street_bev"),
            TableRow(f"{bev}, control", f"tf_lane/{host}_tfm:street_bev_control"),
        ),
        claims=(
            claim(tfm, label, *papers),
            Claim(tfm, f"{tfm}, control", "the gain is the traffic's, not the added layers'"),
            Claim(bev, label, "ours: traffic in the BEV features as well"),
            Claim(bev, f"{bev}, control", "the gain is the traffic's, not the added layers'"),
        ),
        primary=primary[0],
        secondary=secondary,
        negative_control=primary[1],
        alpha=0.01,
        columns=(*columns, *primary),
        quoted=quoted,
        steps=steps,
        minutes=minutes,
        note=note,
    )


_ARCHITECTURE = ("abla1", "abla2", "abla3", "abla4")
# One configuration has one spelling in all tables, by which `core_minutes` knows that they share its runs.
_BEST_ROW = TableRow("abla5", "tf_lane/lanesegnet_tfm:street")


def _on_lanesegnet(
    number: int,
    title: str,
    rows: tuple[TableRow, ...],
    claims: tuple[Claim, ...],
    quoted: Quoted,
    baseline: str = "lanesegnet:street",
    minutes: float = 10.0,
) -> PaperTable:
    """Return one of the ablations on LaneSegNet, with the baseline as the first row."""
    return PaperTable(
        name=f"tf_lane.{number}",
        title=title,
        rows=(TableRow("LaneSegNet", f"tf_lane/{baseline}"), *rows),
        claims=claims,
        primary="all/mAP",
        columns=(*_SEGMENTS, *_GROUPS),
        quoted=quoted,
        seeds=5,
        steps=2000,
        minutes=minutes,
    )


def _ablation(name: str) -> TableRow:
    return TableRow(name, f"tf_lane/lanesegnet_tfm:{name}")


_SEGMENT_COLUMNS = ("mAP", "AP_ls", "AP_ped", "TOP_ll")
_BASELINE = (32.99, 32.75, 33.24, 27.02)
_BEST = (35.02, 34.90, 35.15, 27.83)

TABLES = (
    _with_and_without(
        1,
        "LaneSegNet without and with traffic flow",
        "lanesegnet",
        "LaneSegNet",
        _GROUPS,
        _SEGMENTS,
        "all/mAP",
        steps=2000,
        minutes=7.5,
        quoted=_quoted(
            _LANESEGNET,
            _SEGMENT_COLUMNS,
            **{
                "LaneSegNet": _BASELINE,
                "LaneSegNet + TFM": _BEST,
                "LaneSegNet *": (34.65, 34.04, 35.26, 26.76),
                "LaneSegNet + TFM *": (35.66, 34.52, 36.79, 27.50),
            },
        ),
        papers=("traffic flow improves LaneSegNet ({})", _gain(2.03)),
    ),
    _with_and_without(
        2,
        "TopoNet without and with traffic flow",
        "toponet",
        "TopoNet",
        _GROUPS,
        ("all/DET_l", "all/TOP_ll", "all/recall"),
        "all/DET_l",
        steps=2500,
        minutes=9.0,
        quoted=_quoted(
            f"{_OPENLANE}; OpenLane-V2 metrics, percent, version not given",
            ("OLS", "DET_l", "DET_t", "TOP_ll", "TOP_lt"),
            **{
                "TopoNet": (41.12, 31.08, 44.22, 15.44, 24.89),
                "TopoNet + TFM": (42.29, 31.27, 47.20, 15.97, 25.74),
                "TopoNet *": (41.22, 31.06, 44.62, 15.45, 24.91),
                "TopoNet + TFM *": (42.39, 31.22, 47.44, 15.97, 25.96),
            },
        ),
        papers=("traffic flow improves TopoNet ({})", Reported(0.19, "DET_l", 2), Reported(1.17, "OLS", 2)),
        note="There is no DET_t, TOP_lt and OLS: BEV evidence shows no traffic elements, so this host predicts none. "
        "The gains in the first claim are the paper's.",
    ),
    _with_and_without(
        3,
        "MapTR without and with traffic flow",
        "maptr",
        "MapTR",
        ("lines hidden+traffic/recall", "lines hidden-traffic/recall"),
        _LINES,
        "lines/mAP",
        steps=2000,
        minutes=12.0,
        quoted=_quoted(
            _NUSCENES,
            ("mAP", "AP_divider", "AP_ped_crossing", "AP_boundary"),
            **{
                "MapTR": (51.51, 53.92, 47.76, 52.86),
                "MapTR + TFM": (55.61, 59.28, 50.05, 57.52),
                "MapTR *": (51.63, 54.12, 47.86, 52.91),
                "MapTR + TFM *": (55.80, 58.75, 51.10, 57.57),
            },
        ),
        papers=("traffic flow improves MapTR ({})", Reported(4.1, "mAP")),
    ),
    _with_and_without(
        4,
        "MapTRv2 without and with traffic flow",
        "maptrv2",
        "MapTRv2",
        ("lines hidden+traffic/recall", "lines hidden-traffic/recall"),
        _LINES,
        "lines/mAP",
        steps=1500,
        minutes=4.5,
        quoted=_quoted(
            _NUSCENES,
            ("mAP", "AP_divider", "AP_ped_crossing", "AP_boundary"),
            **{
                "MapTRv2": (62.19, 63.39, 59.00, 64.18),
                "MapTRv2 + TFM": (63.50, 63.65, 61.76, 65.09),
                "MapTRv2 *": (62.19, 63.39, 59.00, 64.18),
                "MapTRv2 + TFM *": (63.50, 63.65, 61.76, 65.09),
            },
        ),
        papers=("traffic flow improves MapTRv2 ({})", _gain(1.31)),
    ),
    _on_lanesegnet(
        5,
        "architecture of the TFM: fusion modules, depth, normalised coordinates",
        (*map(_ablation, _ARCHITECTURE), _BEST_ROW, *map(_ablation, ("abla1_spatial", "abla3_spatial"))),
        (
            claim("abla2", "abla1", "one layer is better than three, with all four fusion modules ({})", _gain(1.26)),
            Claim("abla2", "abla1_spatial", "the same, depth read as layers of the spatial encoder"),
            claim("abla4", "abla3", "the text: reducing depth helps; the table: {} with LT/LL", _gain(-0.89)),
            Claim("abla4", "abla3_spatial", "the same, depth read as layers of the spatial encoder"),
            claim("abla5", "abla4", "normalised coordinates help ({})", _gain(1.93)),
            claim("abla5", "LaneSegNet", "the best setting improves LaneSegNet ({})", _gain(2.03)),
        ),
        _quoted(
            _LANESEGNET,
            ("Pipe.", "Dep.", "Norm.", *_SEGMENT_COLUMNS),
            **{
                "LaneSegNet": ("-", "-", "-", *_BASELINE),
                "abla1": ("All", "3", "F", 32.98, 32.97, 33.00, 27.98),
                "abla2": ("All", "1", "F", 34.24, 34.37, 34.10, 27.82),
                "abla3": ("LT/LL", "3", "F", 33.98, 32.75, 35.22, 27.04),
                "abla4": ("LT/LL", "1", "F", 33.09, 32.48, 33.71, 27.46),
                "abla5": ("LT/LL", "1", "T", *_BEST),
            },
        ),
        minutes=7.0,
    ),
    _on_lanesegnet(
        6,
        "number of road users and least number of valid frames, on `city`",
        tuple(TableRow(name, f"tf_lane/lanesegnet_tfm:{name}_city") for name in ("abla6", "abla7", "abla8")),
        (
            claim("abla7", "abla6", "30 road users are better than 20 ({})", _gain(0.98)),
            claim("abla7", "abla8", "a threshold of 5 frames is better than 10 ({})", _gain(1.12)),
            claim("abla7", "LaneSegNet", "the best setting improves LaneSegNet ({})", _gain(2.03)),
        ),
        _quoted(
            _LANESEGNET,
            ("N_t", "tol_pts", *_SEGMENT_COLUMNS),
            **{
                "LaneSegNet": ("-", "-", *_BASELINE),
                "abla6": (20, 5, 34.04, 32.05, 36.04, 27.55),
                "abla7": (30, 5, *_BEST),
                "abla8": (30, 10, 33.90, 34.55, 33.24, 27.55),
            },
        ),
        baseline="lanesegnet",  # on `street`, hardly a frame has more than 30 road users in range
    ),
    _on_lanesegnet(
        7,
        "training with traffic flow, inference without",
        (
            TableRow("LaneSegNet + TFM", "tf_lane/lanesegnet_tfm:street"),
            TableRow("LaneSegNet + TFM, control", "tf_lane/lanesegnet_tfm:street_control"),
        ),
        (
            claim(
                _WITHOUT,
                "LaneSegNet",
                "a model trained with traffic flow is better than the baseline even without it ({})",
                _gain(1.33),
            ),
            Claim(_WITHOUT, "LaneSegNet + TFM, control", "and the traffic in training is why"),
            claim("LaneSegNet + TFM", _WITHOUT, "traffic flow at inference helps ({})", _gain(0.70)),
        ),
        _quoted(
            _LANESEGNET,
            ("N_t in training", "N_t in evaluation", *_SEGMENT_COLUMNS),
            **{
                "LaneSegNet": ("-", "-", *_BASELINE),
                "LaneSegNet + TFM": (30, 30, *_BEST),
                _WITHOUT: (30, 0, 34.32, 33.54, 35.10, 27.82),
            },
        ),
        minutes=7.5,
    ),
)


def _long(name: str, title: str, treatment: str, claim: str, minutes: float) -> PaperTable:
    """Return two rows of Table 2, a treatment and its control, with four times the updates."""
    short, control = TABLES[1], f"{treatment}, control"
    return PaperTable(
        name=name,
        title=title,
        rows=tuple(row for row in short.rows if row.name in (treatment, control)),
        claims=(Claim(treatment, control, claim),),
        primary=_GROUPS[0],
        secondary="all/DET_l",
        negative_control=_GROUPS[1],
        alpha=0.01,
        columns=short.columns,
        quoted=Quoted("no numbers: the paper has no ablation of the length of training (all its rows: 60 epochs)", ()),
        seeds=5,
        steps=10_000,
        minutes=minutes,
    )


LONG = (
    _long(
        "tf_lane.2_long",
        "the paper's module in TopoNet, four times the updates of tf_lane.2",
        "TopoNet + TFM",
        "traffic flow improves TopoNet once it has trained long",
        minutes=27.5,
    ),
    _long(
        "tf_lane.2_bev_long",
        "traffic in TopoNet's BEV features (ours), four times the updates of tf_lane.2",
        "TopoNet + TFM + BEV",
        "the gain of traffic in the BEV features lasts when models train long",
        minutes=19.4,
    ),
)
"""Whether the short trainings of Table 2 are why the module shows no gain there, and why traffic in the BEV features
does."""

_MASKS = {
    "quadrants, All": "all",
    "joint softmax, LT/LL": "joint",
    "joint softmax, All": "joint_all",
    "windows by head": "heads",
    "window of 6 m": "window",
    "4 nearest instances": "nearest",
    "causal in time": "causal",
}

MASKING = PaperTable(
    name="tf_lane.masking",
    title="which lanes may attend to which road users: masking variants of the TFM",
    rows=(
        TableRow("TopoNet", "tf_lane/toponet:street"),
        TableRow("quadrants, LT/LL", "tf_lane/toponet_tfm:street"),
        *(TableRow(name, f"tf_lane/masking:{ablation}") for name, ablation in _MASKS.items()),
    ),
    claims=tuple(Claim(name, "quadrants, LT/LL") for name in _MASKS),
    primary=_GROUPS[0],
    negative_control=_GROUPS[1],
    columns=("all/DET_l", "all/TOP_ll", "all/recall", *_GROUPS),
    quoted=Quoted("no numbers: the paper compares All with LT/LL only (Table 5)", ()),
    seeds=3,
    steps=2500,
    minutes=7.5,
)
