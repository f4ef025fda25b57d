"""Videos as files, read and written with OpenCV (extra `images`) frame by frame."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import replacing
from tflane_jax.files.images import opencv, quiet_opencv

VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".webm")
_USUAL_RATE = 25.0  # frames a second, where a file does not tell


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header says.

    Attributes:
        frames: number of frames, an estimate; 0 where the file does not tell.
        rate: frames a second.
        width, height: pixels.
    """

    frames: int
    rate: float
    width: int
    height: int


def video_info(path: Path) -> VideoInfo:
    """Return the header of a video; raises UserError where it cannot be read."""
    with _opened(path) as video:
        cv2 = opencv()
        rate = float(video.get(cv2.CAP_PROP_FPS))
        return VideoInfo(
            frames=max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0),
            rate=rate if 0.0 < rate < 1000.0 else _USUAL_RATE,
            width=int(video.get(cv2.CAP_PROP_FRAME_WIDTH)),
            height=int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )


def read_frames(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the frames of a video as RGB, all of one size.

    Raises UserError where the file cannot be read, has no frame, or changes its size.
    """
    cv2, size = opencv(), None
    with _opened(path) as video:
        while True:
            read, frame = video.read()
            if not read:
                break
            if size is not None and frame.shape != size:
                raise UserError(f"{path}: the frames change their size from {size} to {frame.shape}: convert it first")
            size = frame.shape
            yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
    if size is None:
        raise UserError(f"{path} is a video without a readable frame: open it in a player and save it as MP4")


def sample_frames(path: Path, count: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return some frames spread over a video, at least the first; raises UserError as `read_frames`.

    A video whose header does not tell how many it has is read once from start to end.
    """
    cv2, total = opencv(), video_info(path).frames
    if total == 0:
        return _spread(read_frames(path), count)
    found = [next(read_frames(path))]
    with _opened(path) as video:
        for i in range(1, count):
            video.set(cv2.CAP_PROP_POS_FRAMES, i * total // count)
            read, frame = video.read()
            if read and frame.shape == found[0].shape:
                found.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
    return found


def _spread(frames: Iterator[UInt8[np.ndarray, "h w 3"]], count: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return `count` of any number of frames, fewer if there are fewer; at most twice as many are kept at a time."""
    kept: list[UInt8[np.ndarray, "h w 3"]] = []
    step = 1
    for number, frame in enumerate(frames):
        if number % step == 0:
            if len(kept) == 2 * count:
                kept, step = kept[::2], 2 * step
            kept.append(frame)
    return [kept[i * len(kept) // count] for i in range(count)] if len(kept) > count else kept


class VideoWriter:
    """Writes frames of one size; see `writing_video`."""

    def __init__(self, writer: Any) -> None:
        """Take OpenCV's writer."""
        self._writer = writer

    def add(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append an RGB frame."""
        cv2 = opencv()
        self._writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))


@contextlib.contextmanager
def writing_video(path: Path, info: VideoInfo) -> Iterator[VideoWriter]:
    """Yield a writer of an MP4 file, which appears whole or not at all.

    Raises UserError where OpenCV cannot write it.
    """
    cv2 = opencv()
    with replacing(path) as temporary:
        partial = temporary.with_name(temporary.name + ".mp4")  # OpenCV chooses the format by the suffix
        code = cv2.VideoWriter.fourcc(*"mp4v")
        with quiet_opencv():
            writer = cv2.VideoWriter(str(partial), code, _writable_rate(info.rate), (info.width, info.height))
        try:
            if not writer.isOpened():
                raise UserError(f"OpenCV cannot write {path}: check the folder, or install OpenCV with FFmpeg")
            yield VideoWriter(writer)
            writer.release()
            partial.rename(temporary)
        finally:
            writer.release()
            partial.unlink(missing_ok=True)


def _writable_rate(rate: float) -> float:
    """Return the rate, rounded where MPEG-4 cannot count its ticks, of which a second has at most 65,535."""
    exact = (round(rate, digits) for digits in (3, 2, 1) if round(rate, digits) * 10**digits < 2**16)
    return next(exact, round(rate))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    with quiet_opencv() as cv2:
        video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise UserError(f"{path} is damaged or no video of a known format: open it in a player and save it as MP4")
        yield video
    finally:
        video.release()
