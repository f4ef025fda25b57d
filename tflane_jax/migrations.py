"""Saved configurations of older versions, brought to the names of this one.

A run folder holds its configuration as JSON (`config_io.to_json`). When a setting is renamed, moved or removed, add an
entry to `MIGRATIONS`; folders written before then still open and resume. An entry is a function from the JSON of a
whole configuration to its new JSON and to notices for the user. It must leave a configuration of this version as it is,
because files carry no version number. A setting that is new needs no entry: it takes its default.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tflane_jax.errors import UserError

Json = dict[str, Any]
Migration = Callable[[Json], tuple[Json, list[str]]]
"""JSON of a configuration -> its new JSON, notices. The input is not changed."""

_MISSING = object()


def migrate(content: Json, migrations: Sequence[Migration] | None = None) -> tuple[Json, list[str]]:
    """Apply all migrations, oldest first.

    Args:
        content: what a run folder or checkpoint holds.
        migrations: default `MIGRATIONS`.

    Returns:
        The configuration in the names of this version, and one line for each change that a user should know.

    Raises:
        UserError: a removed setting has a value that this version no longer supports.
    """
    notices: list[str] = []
    for migration in MIGRATIONS if migrations is None else migrations:
        try:
            content, more = migration(content)
        except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
            raise UserError(f"the saved configuration is damaged ({type(error).__name__}: {error})") from error
        notices += more
    return content, notices


# ---------------------------------------------------------------------------------------------------------------------
# Kinds of migrations. `kind` is the class name of a configuration as saved; it is found anywhere in the tree.


def renamed_class(old: str, new: str) -> Migration:
    """Return the migration for a configuration class that has another name now."""

    def rename(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
        return node | {"class": new}, []

    return _at_class(old, rename)


def renamed_setting(kind: str, old: str, new: str) -> Migration:
    """Return the migration for a setting of class `kind` that has another name now."""

    def rename(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
        return {new if name == old else name: value for name, value in node.items()}, []

    return _at_class(kind, rename)


def removed_setting(kind: str, name: str, always: Any, *, instead: str = "") -> Migration:
    """Return the migration for a setting of class `kind` that no longer exists.

    The setting is dropped with a notice where its saved value is what this version always uses.

    Args:
        kind: class that had the setting.
        name: of the setting.
        always: JSON of the value that this version always uses, or a function from the whole configuration to it
            (see `value_at`), for a value that follows from another setting.
        instead: sentence for the error: what to do where another value is needed.

    The migration raises UserError for any other value.
    """

    def remove(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
        if name not in node:
            return node, []
        kept, saved = {key: value for key, value in node.items() if key != name}, node[name]
        used = always(root) if callable(always) else always
        if saved != used:
            raise UserError(
                f"setting {path}{name} is {saved}: this version has no such setting and always uses {used}"
                + (f". {instead}" if instead else "")
            )
        return kept, [f"setting {path}{name} no longer exists: its value, {saved}, is what this version always uses"]

    return _at_class(kind, remove)


def unused_setting(kind: str, name: str) -> Migration:
    """Return the migration for a setting of class `kind` that nothing read: it is dropped, whatever its value.

    There is a notice, so that nobody believes that it had an effect.
    """

    def remove(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
        if name not in node:
            return node, []
        kept = {key: value for key, value in node.items() if key != name}
        return kept, [f"setting {path}{name} no longer exists: its value, {node[name]}, never had an effect"]

    return _at_class(kind, remove)


def moved_setting(old: str, new: str) -> Migration:
    """Return the migration for a setting with another place now; both are dotted names from the top.

    Nothing moves where the configuration has no setting `old`, or no part that `new` belongs to.
    """

    def move(root: Json) -> tuple[Json, list[str]]:
        value, (parent, _, name) = value_at(root, old, _MISSING), new.rpartition(".")
        owner = value_at(root, parent, None) if parent else root
        if value is _MISSING or not isinstance(owner, dict):
            return root, []
        root = _replaced(root, old.split("."), _MISSING)
        return _replaced(root, new.split("."), owner.get(name, value)), []

    return move


def nested_settings(kind: str, names: Sequence[str], part: str, part_kind: str) -> Migration:
    """Return the migration for settings of class `kind` that are now inside `part`, a configuration `part_kind`."""

    def nest(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
        moved = {name: node[name] for name in names if name in node}
        if not moved:
            return node, []
        kept = {name: value for name, value in node.items() if name not in moved}
        return kept | {part: {"class": part_kind} | moved | (node.get(part) or {})}, []

    return _at_class(kind, nest)


def value_at(root: Json, name: str, default: Any = None) -> Any:
    """Return the value of a setting by its dotted name, `default` where the configuration has none."""
    node: Any = root
    for part in name.split("."):
        if not isinstance(node, dict) or part not in node:
            return default
        node = node[part]
    return node


def _at_class(kind: str, change: Callable[[Json, str, Json], tuple[Json, list[str]]]) -> Migration:
    """Return the migration that applies (node, "path.to.it.", root) -> (node, notices) to every node of a class."""

    def apply(root: Json) -> tuple[Json, list[str]]:
        notices: list[str] = []

        def walk(value: Any, path: str) -> Any:
            if isinstance(value, list):
                return [walk(item, path) for item in value]
            if not isinstance(value, dict):
                return value
            node = {name: walk(item, f"{path}{name}.") for name, item in value.items()}
            if node.get("class") != kind:
                return node
            node, more = change(node, path, root)
            notices.extend(more)
            return node

        return walk(root, ""), notices

    return apply


def _replaced(node: Json, parts: Sequence[str], value: Any) -> Json:
    """Return a configuration with one setting replaced, or without it where `value` is `_MISSING`."""
    first, *rest = parts
    if rest:
        return node | {first: _replaced(node[first], rest, value)}
    kept = {name: item for name, item in node.items() if name != first}
    return kept if value is _MISSING else kept | {first: value}


# ---------------------------------------------------------------------------------------------------------------------
# Changes that belong to one setting.

_MODEL = "task.model"
_BEV_RANGE = {"class": "PerceptionRange", "x": [-51.2, 51.2], "y": [-25.6, 25.6], "z": [-2.3, 1.7]}


def _bev_range(root: Json) -> Any:
    """Return the box that a host's BEV features cover: of its cameras' grid, or of its raster."""
    of_cameras = value_at(root, f"{_MODEL}.encoder.bev.grid.range")
    return of_cameras or value_at(root, f"{_MODEL}.encoder.range", _BEV_RANGE)


def _range_of_raster(root: Json) -> tuple[Json, list[str]]:
    """Move the range of the lane decoder to the encoder of an evidence raster, which states it now."""
    if value_at(root, f"{_MODEL}.encoder.class") != "EvidenceEncoderConfig":
        return root, []
    return moved_setting(f"{_MODEL}.decoder.range", f"{_MODEL}.encoder.range")(root)


def _loss_of_host(root: Json) -> tuple[Json, list[str]]:
    """Name the loss after the host that it belongs to."""
    of_baseline = value_at(root, f"{_MODEL}.class") == "BevFormerDetrConfig"
    return renamed_class("LaneGraphLossConfig", "BevFormerDetrLossConfig" if of_baseline else "TopoNetLossConfig")(root)


def _edge_weight_of_scene_graph(root: Json) -> tuple[Json, list[str]]:
    """Move the edge weight of the lane decoder to TopoNet, whose scene graph alone read it."""
    if value_at(root, f"{_MODEL}.class") != "TopoNetConfig":
        return root, []
    return moved_setting(f"{_MODEL}.decoder.edge_weight", f"{_MODEL}.edge_weight")(root)


def _unused_reference_batch(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
    """Drop the former default of a setting that changed nothing, because the learning rate was not scaled."""
    unused = node.get("lr_scaling") == "none" and node.get("reference_batch") == 8
    return node | {"reference_batch": None} if unused else node, []


def _former_workers(node: Json, path: str, root: Json) -> tuple[Json, list[str]]:
    """Drop the former defaults of the workers that load examples, on which no example depends."""
    former = node.get("threads") == 4 and node.get("ahead") == 16
    return node | {"threads": None, "ahead": None} if former else node, []


# ---------------------------------------------------------------------------------------------------------------------
# The changes so far, oldest first. Add new ones at the end.

MIGRATIONS: tuple[Migration, ...] = (
    renamed_class("LaneCurveTask", "LaneShapeTask"),
    renamed_class("LaneCurveLossConfig", "LaneShapeLossConfig"),
    renamed_setting("OptimConfig", "matrices", "optimizer"),
    renamed_setting("MarkerFusionConfig", "reach", "radius"),
    renamed_setting("SdMapModuleConfig", "reach", "radius"),
    renamed_setting("AdaptiveConfig", "share", "fraction"),
    # Ranges are those of the host.
    moved_setting(f"{_MODEL}.traffic_flow.prior.region", f"{_MODEL}.range"),
    _range_of_raster,
    removed_setting("LaneDecoderConfig", "range", _bev_range),
    removed_setting("TrafficFlowPriorConfig", "bev_range", _bev_range),
    removed_setting("SdMapPriorConfig", "range", _bev_range),
    removed_setting("TrafficFlowModuleConfig", "query_type", "instance"),
    # Priors are one part of a host, losses belong to hosts.
    nested_settings("TopoNetConfig", ("traffic_flow", "sd_map", "markers"), "priors", "PriorsConfig"),
    nested_settings("BevFormerDetrConfig", ("sd_map", "markers"), "priors", "PriorsConfig"),
    removed_setting("LaneGraphLossConfig", "control_points", lambda root: value_at(root, f"{_MODEL}.control_points")),
    _loss_of_host,
    _at_class("OptimConfig", _unused_reference_batch),
    # Settings belong to the classes that read them.
    _edge_weight_of_scene_graph,
    unused_setting("LaneDecoderConfig", "edge_weight"),
    unused_setting("SegmentDecoderConfig", "edge_weight"),
    unused_setting("MapTrLossConfig", "cell_weight"),
    unused_setting("MapTrV2LossConfig", "cell_weight"),
    _at_class("StreamingConfig", _former_workers),
    removed_setting("LaneSegNetLossConfig", "successor_mean", "negatives"),
)
