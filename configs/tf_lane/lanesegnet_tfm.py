"""LaneSegNet with the traffic-flow module, and the ablations of the paper's Tables 5 and 6.

    tflane train --config tf_lane/lanesegnet_tfm
    tflane train --config tf_lane/lanesegnet_tfm:street

Same data, optimizer and host as `lanesegnet.py`; the settings of the module, and the names of the rows, are those of
`toponet_tfm.py`. The ablations run on the preset `street`; those of Table 6 also on `city` (`abla6_city` and so on),
where more than N_t road users are in range.

`tflane tables tf_lane.1`, 2,000 updates, eight seeds, recall of hidden lanes that vehicles drove along, percent:
`:street` 31.8 ± 0.6 (control 31.2 ± 0.8), `:street_bev` 37.6 ± 0.5 (control 31.6 ± 0.7). `tf_lane.5` and `.6`, 2,000
updates, five seeds, mAP: `:abla1` to `:abla5` 37.3 to 38.0 (LaneSegNet 38.1 ± 1.4), `:abla6_city` to `:abla8_city` 39.8
to 40.1 (39.8 ± 0.4).
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config, with_priors_of

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    traffic = load_config(str(HERE.with_name("toponet_tfm.py")))
    return with_priors_of(traffic, load_config(str(HERE.with_name("lanesegnet.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the rows of `toponet_tfm.py` on LaneSegNet."""
    rows = load_ablations(str(HERE.with_name("toponet_tfm.py")))
    street, city = (load_config(str(HERE.with_name(name))) for name in ("lanesegnet.py:street", "lanesegnet.py"))
    on_street = {name: with_priors_of(row, street) for name, row in rows.items()}
    return on_street | {f"{name}_city": with_priors_of(rows[name], city) for name in ("abla6", "abla7", "abla8")}
