"""Scenes of frames whose files do not name them, for numbers by scene and for the bootstrap over scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.fields import as_list, is_text, load_file, member, shown


def read_scenes(path: Path) -> dict[str, str]:
    """Return the scene of each frame.

    Args:
        path: a JSON object {frame: scene}, or nuScenes' table `sample.json`, a list of {"token", "scene_token"}.

    Raises:
        UserError: names the file and the entry.
    """
    content = load_file(path)
    if isinstance(content, Mapping):
        pairs = [(str(frame), scene, f"{path}: {frame}") for frame, scene in content.items()]
    else:
        pairs = []
        for i, row in enumerate(as_list(content, str(path))):
            where = f"{path}: row {i}"
            pairs.append((str(member(row, "token", where)), member(row, "scene_token", where), where))
    scenes: dict[str, str] = {}
    for frame, scene, where in pairs:
        if not is_text(scene) or not scene:
            raise UserError(f"{where} has the scene {shown(scene)}, expected a text")
        if scenes.setdefault(frame, scene) != scene:
            raise UserError(f"{where} has the scene {shown(scene)}, another row {shown(scenes[frame])}: name one")
    return scenes


def scene_names(scenes: Mapping[str, str], frames: Iterable[Any], path: Path) -> Callable[[Any], str]:
    """Return the function from a frame to its scene; raises UserError that names frames without one."""
    lost = [str(frame) for frame in frames if str(frame) not in scenes]
    if lost:
        more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
        raise UserError(f"{path} names no scene for {', '.join(lost[:3])}{more}")
    return lambda frame: scenes[str(frame)]
