"""Lane lines in a photo of any camera: for an unknown camera, the view that suits the network is searched.

The network was trained on one camera, TuSimple's. Cutting sky off the top moves the horizon to its row, and cutting the
sides gives a wide lens its field of view. With the right cut, the predicted lanes meet in one point on the horizon, do
not cross, and lie on paint (`evaluation.photo_lanes`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.datasets.photos import FOCAL, HORIZON, PhotoCamera, Placement, fit_photo, is_alike, misfits
from tflane_jax.evaluation.photo_lanes import Judgement, common_horizon, is_blank, judge_lanes, without_crossings
from tflane_jax.evaluation.predict import Predictor
from tflane_jax.files.images import opencv
from tflane_jax.geometry.cameras import inside_image
from tflane_jax.geometry.lane_shapes import curve_columns
from tflane_jax.models.parameters import Params
from tflane_jax.scene import LaneLines, RoadImage, row_of
from tflane_jax.tasks.lane_shape import predict_curves

# Rows of the horizon that are tried, as fractions of a photo's height, and widths of the view, of the photo's width.
_HORIZONS = (0.3, 0.36, 0.42, 0.48, 0.54, 0.6)
_WIDTHS = (1.0, 0.75, 0.55)
_FINE_WIDTHS = (1.0, 0.85, 0.7, 0.55)
# The value from which a whole photo is taken without a search (TuSimple's ten frames at hand have 0.23 up), and the
# ranks from which a view is taken without a warning, and taken at all.
_SURE, _PLAUSIBLE, _LEAST = 0.2, 0.15, 0.05
_POINTS = 100
_EMPTY = "the photo is empty: it has one brightness almost everywhere"
_NOTHING = (
    "no lanes: no part of the photo shows any that meet in one point, do not cross, and lie on paint. If it shows a "
    "road, give --horizon (row) and --focal (pixels)"
)


@dataclass(frozen=True)
class PhotoLanes:
    """Lanes found in a photo.

    Attributes:
        view: the part of the photo that the network saw.
        lanes: (column, row) in pixels of the photo, from the upper to the lower end; from left to right.
        scores: of the lanes, 0 to 1.
        paint: fraction of each lane that lies on paint.
        value: plausibility of the view, see `Judgement`.
        warning: what is doubtful; "" if nothing is.
    """

    view: Placement
    lanes: tuple[Float[np.ndarray, "p 2"], ...]
    scores: tuple[float, ...]
    paint: tuple[float, ...]
    value: float
    warning: str


@dataclass(frozen=True)
class _ViewLanes:
    """Lanes that the network finds in a view, fractions of the view, and how plausible they are."""

    view: Placement
    lanes: list[Float[np.ndarray, "p 2"]]
    scores: Float[np.ndarray, " l"]
    judged: Judgement


class PhotoReader:
    """Reads photos with one model.

    Args:
        task: of lane shapes.
        params: of the model.
        threshold: least score of a lane.
    """

    def __init__(self, task: Predictor, params: Params, threshold: float = 0.5) -> None:
        self.task, self.params, self.threshold = task, params, threshold

    def read(self, photo: UInt8[np.ndarray, "h w 3"], camera: PhotoCamera | None = None) -> PhotoLanes:
        """Return the lanes of a photo.

        The view is searched unless the camera's horizon is known; a known focal length narrows the search.

        Raises UserError for a camera that does not fit the photo.
        """
        grey = _grey(photo)
        if is_blank(grey):
            view = fit_photo(photo, camera).placement
            return PhotoLanes(view, (), (), (), 0.0, _EMPTY)
        if camera is not None and camera.horizon is not None:
            return self._checked(photo, self._of_camera(photo, grey, camera), camera.horizon)
        return self._checked(photo, self._search(photo, grey, None if camera is None else camera.focal))

    def find_view(self, photos: Iterable[UInt8[np.ndarray, "h w 3"]], focal: float | None = None) -> Placement | None:
        """Return the view that suits frames of one camera best; None if no frame shows plausible lanes.

        Args:
            photos: of one size.
            focal: focal length, pixels, where it is known.
        """
        found = []
        for photo in photos:
            if not is_blank(grey := _grey(photo)):
                seen = self._search(photo, grey, focal)
                found.append((_worth(seen, photo), seen.view))
        worth, view = max(found, key=lambda one: one[0], default=(0.0, None))
        return None if worth < _LEAST else view

    def read_view(self, photo: UInt8[np.ndarray, "h w 3"], view: Placement) -> PhotoLanes:
        """Return the lanes in a view that `find_view` found in other frames of the camera."""
        grey = _grey(photo)
        if is_blank(grey):
            return PhotoLanes(view, (), (), (), 0.0, _EMPTY)
        return self._checked(photo, self._in_view(photo, grey, view))

    def _search(
        self, photo: UInt8[np.ndarray, "h w 3"], grey: UInt8[np.ndarray, "h w"], focal: float | None
    ) -> _ViewLanes:
        height, width = grey.shape
        whole = self._of_camera(photo, grey, PhotoCamera(focal))
        if whole.judged.value >= _SURE and is_alike(width, height):
            return whole
        tried = {whole.view: whole}
        for horizon in _HORIZONS:
            self._try(tried, photo, grey, PhotoCamera(focal, horizon * height))
            for part in _WIDTHS if focal is None else ():
                self._try(tried, photo, grey, PhotoCamera(FOCAL * width * part, horizon * height))
        meeting = common_horizon([seen.judged for seen in tried.values()], height)
        if meeting is not None and meeting[1] < 0.9 * height:
            ahead = min(max(meeting[0], 0.25 * width), 0.75 * width)
            self._try(tried, photo, grey, PhotoCamera(focal, meeting[1]))
            for one in [FOCAL * width * part for part in _FINE_WIDTHS] if focal is None else [focal]:
                for column in (None, ahead):
                    self._try(tried, photo, grey, PhotoCamera(one, meeting[1], column))
        return max(tried.values(), key=lambda seen: seen.judged.rank)

    def _try(self, tried: dict[Placement, _ViewLanes], photo, grey, camera: PhotoCamera) -> None:
        if camera.horizon is not None and camera.horizon <= 1.0:
            return  # at the upper border of the photo
        view = fit_photo(photo, camera).placement
        if view not in tried:
            tried[view] = self._in_view(photo, grey, view)

    def _of_camera(self, photo, grey, camera: PhotoCamera) -> _ViewLanes:
        return self._in_view(photo, grey, fit_photo(photo, camera).placement)

    def _in_view(self, photo, grey, view: Placement) -> _ViewLanes:
        fitted = fit_photo(photo, view)
        example = RoadImage(fitted.image, fitted.image_valid, LaneLines.empty(1, 1))
        stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], example)
        answer = row_of(predict_curves(self.task, self.params, stacked), 0)
        scores = np.asarray(answer.scores)
        curves = np.asarray(answer.curves, np.float64)
        # A lane that would end above its beginning has no points, as in TuSimple's metric.
        chosen = np.flatnonzero((scores >= self.threshold) & (curves[:, 1] > curves[:, 0]))
        curves = curves[chosen]
        rows = np.linspace(curves[:, 0], curves[:, 1], _POINTS, axis=-1)
        lanes = np.stack([curve_columns(curves[:, 2:], rows), rows], -1)
        order = np.argsort(lanes[:, -1, 0], kind="stable")
        lanes, scores = list(lanes[order]), scores[chosen][order]
        return _ViewLanes(view, lanes, scores, judge_lanes(grey, view, lanes, scores))

    def _checked(self, photo: UInt8[np.ndarray, "h w 3"], seen: _ViewLanes, horizon: float | None = None) -> PhotoLanes:
        """Return what is plausible, in pixels of the photo: below the horizon, inside, not crossing.

        Without a known `horizon` (row) the view was searched, and may show nothing that is plausible.
        """
        judged, (height, width) = seen.judged, photo.shape[:2]
        searched = horizon is None and not _is_whole(seen.view, photo)
        worth_of_view = judged.value if horizon is not None else _worth(seen, photo)
        if horizon is None and worth_of_view < _LEAST:
            return PhotoLanes(seen.view, (), (), (), judged.value, _NOTHING)
        # Lanes meet above their view's horizon where the road rises. Those of a known camera may be nearly parallel and
        # meet anywhere.
        top = seen.view.top + HORIZON * seen.view.height if horizon is None else horizon
        if horizon is None and judged.meeting is not None and not judged.crossed:
            top = min(top, judged.meeting[1])
        lanes, worth, kept = [], [], []
        believed = [i for i in range(len(seen.lanes)) if not searched or judged.supported[i]]
        for i in believed:
            lane = seen.lanes[i]
            points = seen.view.to_photo(lane)
            points = points[inside_image(points, width, height) & (points[:, 1] >= top)]
            if len(points) > 1:
                lanes.append(points)
                worth.append(float(seen.scores[i]) + judged.paint[i])
                kept.append(i)
        clear = without_crossings(lanes, worth, seen.view.width)
        warnings = [] if horizon is None else misfits(seen.view, horizon)
        if len(lanes) < len(believed):
            warnings.append(f"{len(believed) - len(lanes)} of {len(believed)} lanes lie above the horizon or outside")
        if not clear.all():
            warnings.append(f"lanes that cross others are left out ({int((~clear).sum())})")
        if judged.crossed and clear.all():
            warnings.append("the lanes would cross before the horizon")
        if seen.lanes and worth_of_view < _PLAUSIBLE and not judged.crossed:
            warnings.append("the lanes hardly lie on paint or do not meet on the horizon: look at the picture")
        shown = [k for k, keep in zip(range(len(lanes)), clear, strict=True) if keep]
        return PhotoLanes(
            seen.view,
            tuple(lanes[k] for k in shown),
            tuple(float(seen.scores[kept[k]]) for k in shown),
            tuple(judged.paint[kept[k]] for k in shown),
            judged.value,
            "; ".join(warnings),
        )


def _worth(seen: _ViewLanes, photo: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the plausibility of a view: of a searched one, only lanes on paint count."""
    return seen.judged.value if _is_whole(seen.view, photo) else seen.judged.rank


def _is_whole(view: Placement, photo: UInt8[np.ndarray, "h w 3"]) -> bool:
    return view == fit_photo(photo).placement


def _grey(photo: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    cv2 = opencv()
    return np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
