"""MapTR with the traffic-flow module, whose queries are points: Eq. (3) keeps them (TF-Lane, Table 3).

    tflane train --config tf_lane/maptr_tfm
    tflane train --config tf_lane/maptr_tfm:street

Same data, optimizer and host as `maptr.py`; the settings of the module, and the names of the rows, are those of
`toponet_tfm.py`. The ablations run on the preset `street`.

`tflane tables tf_lane.3`, 2,000 updates, eight seeds, recall of hidden lines that vehicles drove along, percent:
`:street` 76.4 ± 1.3 (control 76.3 ± 1.0), `:street_bev` 80.1 ± 1.4 (control 76.0 ± 1.6).
"""

from pathlib import Path

from tflane_jax.config import RunConfig, load_ablations, load_config, with_priors_of

HERE = Path(__file__)


def get_config() -> RunConfig:
    """Return the paper's best setting: LT/LL, depth 1, normalised coordinates, N_t = 30, tol_pts = 5."""
    traffic = load_config(str(HERE.with_name("toponet_tfm.py")))
    return with_priors_of(traffic, load_config(str(HERE.with_name("maptr.py"))))


def ablations() -> dict[str, RunConfig]:
    """Return the rows of `toponet_tfm.py` on MapTR."""
    rows = load_ablations(str(HERE.with_name("toponet_tfm.py")))
    street = load_config(str(HERE.with_name("maptr.py:street")))
    return {name: with_priors_of(row, street) for name, row in rows.items()}
