"""Names of scores in words, for pictures: `gap/recall` is "recall, gap after a board"."""

from __future__ import annotations

_GROUPS = {
    "all": "",
    "occluded": "lanes out of sight",
    "clear": "lanes in sight",
    "hidden+traffic": "hidden lanes driven along",
    "hidden-traffic": "hidden lanes, no vehicle near",
    "visible+traffic": "visible lanes driven along",
    "visible-traffic": "visible lanes, no vehicle near",
    "hidden-neighbours": "hidden lanes, no vehicle beside",
    "seen": "a board in sight",
    "gap": "gap after a board",
    "before": "before the first board",
}


def score_title(name: str) -> str:
    """Return the name of a score ("group/score") in words; other names stay as they are."""
    group, slash, score = name.rpartition("/")
    bare = group.removeprefix("lines ")
    if not slash or bare not in _GROUPS:
        return name
    words = _GROUPS[bare] if bare == group else _GROUPS[bare].replace("lanes", "lines")
    return f"{score}, {words}" if words else score
