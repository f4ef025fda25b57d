"""Every table of the three papers, and of the small host, by name."""

from __future__ import annotations

import difflib

from tflane_jax.ablations.paper import gtn_lane, markers, small_host, tf_lane
from tflane_jax.ablations.paper.table import PaperTable
from tflane_jax.errors import UserError

_ALL = (*tf_lane.TABLES, *tf_lane.LONG, tf_lane.MASKING, *gtn_lane.TABLES, *markers.TABLES, *small_host.TABLES)
TABLES: dict[str, PaperTable] = {table.name: table for table in _ALL}


def find_table(name: str) -> PaperTable:
    """Return a table; raises UserError for an unknown name, with the closest ones."""
    if name in TABLES:
        return TABLES[name]
    close = difflib.get_close_matches(name, TABLES, 3) or list(TABLES)
    raise UserError(f"no table {name}: there is {', '.join(close)} (tflane tables lists all)")
