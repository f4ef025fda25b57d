"""Scenes of frames whose files do not name them, for numbers by scene and for the bootstrap over scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.fields import as_list, is_name, is_text, load_file, member
from tflane_jax.files.wording import named, shown
from tflane_jax.scoring.recognise import check_there


def read_scenes(path: Path) -> dict[str, str]:
    """Return the scene of each frame.

    Args:
        path: a JSON object {frame: scene}, or nuScenes' table `sample.json`, a list of {"token", "scene_token"}.

    Raises:
        UserError: names the file and the entry.
    """
    check_there(path)
    content = load_file(path)
    if isinstance(content, Mapping):
        pairs = [(_frame(frame, str(path)), scene) for frame, scene in content.items()]
        places = [f"{path}: {named(frame)}" for frame, _ in pairs]
    else:
        rows = as_list(content, str(path))
        places = [f"{path}: row {i}" for i in range(len(rows))]
        pairs = [
            (_frame(member(row, "token", where), where), member(row, "scene_token", where))
            for row, where in zip(rows, places, strict=True)
        ]
    scenes: dict[str, str] = {}
    for (frame, scene), where in zip(pairs, places, strict=True):
        if not is_text(scene) or not scene:
            raise UserError(f"{where} has the scene {shown(scene)}, expected a text")
        if scenes.setdefault(frame, scene) != scene:
            raise UserError(f"{where} has the scene {shown(scene)}, another row {shown(scenes[frame])}: name one")
    return scenes


def _frame(name: Any, where: str) -> str:
    if not is_name(name):
        raise UserError(f"{where}: the frame {shown(name)} is no name, expected a text")
    return str(name)


def scene_names(scenes: Mapping[str, str], frames: Iterable[Any], path: Path) -> Callable[[Any], str]:
    """Return the function from a frame to its scene; raises UserError that names frames without one."""
    lost = [str(frame) for frame in frames if str(frame) not in scenes]
    if lost:
        more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
        raise UserError(f"{path} names no scene for {', '.join(map(named, lost[:3]))}{more}")
    return lambda frame: scenes[str(frame)]
