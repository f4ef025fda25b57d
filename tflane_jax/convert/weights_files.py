"""Published weights by name: where they are looked for, where they come from, and how they are recognised."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tflane_jax.convert.renaming import left_out, without_wrappers
from tflane_jax.datasets.cache import cache_root
from tflane_jax.errors import UserError


@dataclass(frozen=True)
class PublishedFile:
    """A file of published weights.

    Attributes:
        files: names that it may have.
        url: where to download it.
        licence: under which its authors published it.
        digest: of its tensors, see `digest_of`; the same for all forms of the file.
        configuration: a shipped one that takes them.
    """

    files: tuple[str, ...]
    url: str
    licence: str
    digest: str
    configuration: str


PUBLISHED: Mapping[str, PublishedFile] = {
    "lstr": PublishedFile(
        files=("LSTR_500000.pkl", "LSTR_500000.npz"),
        url="https://github.com/liuruijin17/LSTR/raw/c8fe59a1d8e1c456c982c9e954ee660ae9116b49/cache/nnet/LSTR/LSTR_500000.pkl",
        licence="BSD 3-Clause",
        digest="cf9fc3eef8b644c7770e6324e9d73d215aa5be201a0a4da948fea794dd1bc211",
        configuration="gtn_lane/lstr",
    )
}
"""By the name that `--weights` takes."""


def find_weights(path: Path) -> tuple[Path, PublishedFile | None]:
    """Return the file of weights, and what it should be if it was given by name.

    A name of `PUBLISHED` is looked for in the folders of $TFLANE_WEIGHTS and in `weights` of the cache; an existing
    file of that name takes precedence.

    Raises UserError that says where the file can be downloaded and where it belongs, or which names there are.
    """
    published = PUBLISHED.get(str(path))
    if path.is_file():
        return path, None
    if published is None:
        if path.name == str(path) and not path.suffix:
            raise UserError(
                f"{path} is neither a file of weights nor a name of published ones, which are {', '.join(PUBLISHED)}"
            )
        return path, None
    named = os.environ.get("TFLANE_WEIGHTS", "")
    try:
        folders = [Path(folder).expanduser() for folder in named.split(os.pathsep) if folder]
    except RuntimeError as error:  # ~user without such a user, or no home folder
        raise UserError(f"TFLANE_WEIGHTS is {named}: {error} Set it to folders") from error
    folders.append(cache_root() / "weights")
    for folder in folders:
        for file in (folder, *(folder / name for name in published.files)):
            if file.is_file() and file.name in published.files:
                return file, published
    raise UserError(
        f"the weights {path} ({' or '.join(published.files)}) are not in {', '.join(map(str, folders))}: download "
        f"{published.url} ({published.licence}) into {folders[-1]}, or name its folder in TFLANE_WEIGHTS. "
        f"The sha256 of its tensors, which is checked, is {published.digest}"
    )


def lane_graph_weights(path: Path) -> Path:
    """Return the file of weights of a lane graph's model; raise UserError for the name of published ones."""
    published = PUBLISHED.get(str(path))
    if published is not None and not path.is_file():
        owner, _, _ = published.configuration.partition("/")
        raise UserError(
            f"the published weights {path} are of {owner} models (--config {published.configuration}): for this "
            "configuration, give a file of its own model's weights, --weights FILE"
        )
    return find_weights(path)[0]


def check_digest(state: Mapping[str, np.ndarray], path: Path, published: PublishedFile | None) -> None:
    """Raise UserError if a file given by name has other tensors than the published one."""
    if published is not None and (found := digest_of(state)) != published.digest:
        raise UserError(
            f"{path} is not the published file: the sha256 of its tensors is {found}, expected {published.digest}. "
            f"Download {published.url} again, or give the path of your own file"
        )


def is_published(state: Mapping[str, np.ndarray]) -> bool:
    """Return whether tensors are those of a file of `PUBLISHED`, wherever they were read from."""
    return digest_of(state) in {file.digest for file in PUBLISHED.values()}


def digest_of(state: Mapping[str, np.ndarray]) -> str:
    """Return the sha256 of names, shapes and float32 values of all weights, in order of their names.

    Counters and the prefix `module.` do not count, so that the digest is the same for .pkl and .npz.
    """
    plain = {without_wrappers(name): tensor for name, tensor in state.items()}
    digest = hashlib.sha256()
    for name in sorted(plain):
        if left_out(name) is None:
            digest.update(f"{name} {plain[name].shape}\n".encode())
            digest.update(np.ascontiguousarray(plain[name], "<f4").tobytes())
    return digest.hexdigest()
