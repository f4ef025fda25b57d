"""MapTRv2 with the traffic-flow module, whose queries are points: Eq. (3) keeps them (TF-Lane, Table 4).

    tflane train --config tf_lane/maptrv2_tfm
    tflane train --config tf_lane/maptrv2_tfm:street

Same data, optimizer and host as `maptrv2.py`; the settings of the module, and the names of the rows, are those of
`toponet_tfm.py`. The ablations run on the preset `street`.

`tflane tables tf_lane.4`, 1,500 updates, eight seeds, recall of hidden lines that vehicles drove along, percent:
`:street` 71.5 ± 1.9 (control 73.3 ± 1.1), `:street_bev` 77.3 ± 1.6 (control 71.5 ± 1.7).
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config, with_priors_of

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    traffic = load_config(str(HERE.with_name("toponet_tfm.py")))
    return with_priors_of(traffic, load_config(str(HERE.with_name("maptrv2.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the rows of `toponet_tfm.py` on MapTRv2."""
    rows = load_ablations(str(HERE.with_name("toponet_tfm.py")))
    street = load_config(str(HERE.with_name("maptrv2.py:street")))
    return {name: with_priors_of(row, street) for name, row in rows.items()}
