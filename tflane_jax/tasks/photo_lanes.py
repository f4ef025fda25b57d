"""Lane lines in a photo of any camera: for an unknown camera, the view that suits the network is searched.

The network was trained on one camera, TuSimple's. Cutting sky off the top moves the horizon to its row, and cutting the
sides gives a wide lens its field of view. With the right cut, the predicted lanes meet in one point on the horizon, do
not cross, lie on paint, reach far, and are those that most other cuts show (`evaluation.photo_lanes`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.datasets.photos import FOCAL, HORIZON, PhotoCamera, Placement, fit_photo, is_alike, misfits
from tflane_jax.evaluation.photo_lanes import (
    Judgement,
    agreement,
    common_horizon,
    is_blank,
    judge_lanes,
    plausibility,
    without_crossings,
)
from tflane_jax.evaluation.predict import Predictor
from tflane_jax.files.images import opencv
from tflane_jax.geometry.cameras import inside_image
from tflane_jax.geometry.lane_shapes import curve_columns, order_from_left
from tflane_jax.models.parameters import Params
from tflane_jax.scene import LaneLines, RoadImage, row_of
from tflane_jax.tasks.lane_shape import predict_curves

# Rows of the horizon that are tried, as fractions of a photo's height, and widths of the view, of the photo's width.
_HORIZONS = (0.3, 0.36, 0.42, 0.48, 0.54, 0.6)
_WIDTHS = (1.0, 0.75, 0.55)
_FINE_WIDTHS = (1.0, 0.85, 0.7, 0.55)
# The value from which a whole photo is taken without a search: TuSimple's ten frames at hand have 0.23 up.
_SURE = 0.2
# From which plausibility a view is taken at all, and without a warning: one of many (`plausibility`), and one that is
# given (value of `Judgement`).
_OF_MANY, _GIVEN = (0.72, 0.9), (0.05, 0.15)
# Views are judged by lanes of this score, whatever lanes are asked for. Of a view that was searched, lanes count that
# lie on paint or that other views show to this extent; one of them must have such a fraction of it on paint.
_JUDGED_SCORE, _AGREED, _PAINTED = 0.5, 0.2, 0.1
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
        value: `plausibility` of a view that was searched among many, `Judgement.value` of one that was given; their
            scales differ, so do not compare them.
        warning: what is doubtful; "" if nothing is.
        needed: from which value the view is taken; None without a choice: the view was given, or the photo is empty.
    """

    view: Placement
    lanes: tuple[Float[np.ndarray, "p 2"], ...]
    scores: tuple[float, ...]
    paint: tuple[float, ...]
    value: float
    warning: str
    needed: float | None = None


@dataclass(frozen=True)
class _ViewLanes:
    """Lanes that the network finds in a view, and how plausible they are.

    Attributes:
        view: the part of the photo.
        lanes: (u, v), fractions of the view.
        points: the same below the view's horizon and inside the photo, pixels.
        scores: of the lanes.
        judged: of this view alone.
    """

    view: Placement
    lanes: list[Float[np.ndarray, "p 2"]]
    points: list[Float[np.ndarray, "p 2"]]
    scores: Float[np.ndarray, " l"]
    judged: Judgement


@dataclass(frozen=True)
class _Choice:
    """The view that is taken, and whether to believe it.

    Attributes:
        seen: its lanes.
        value: its plausibility.
        bounds: from which value it is taken at all, and without a warning.
        believed: which lanes are.
        needed: see `PhotoLanes`.
    """

    seen: _ViewLanes
    value: float
    bounds: tuple[float, float]
    believed: Bool[np.ndarray, " l"]
    needed: float | None = None


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
            seen = self._in_view(photo, grey, fit_photo(photo, camera).placement)
            return self._checked(photo, self._given(photo, grey, seen, least=0.0), camera.horizon)
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
                found.append(self._search(photo, grey, focal))
        # How much it is above what is asked of it: a whole frame may have been taken without a search.
        best = max(found, key=lambda choice: choice.value / choice.bounds[0], default=None)
        return None if best is None or best.value < best.bounds[0] else best.seen.view

    def read_view(self, photo: UInt8[np.ndarray, "h w 3"], view: Placement) -> PhotoLanes:
        """Return the lanes in a view that `find_view` found in other frames of the camera."""
        grey = _grey(photo)
        if is_blank(grey):
            return PhotoLanes(view, (), (), (), 0.0, _EMPTY)
        return self._checked(photo, self._given(photo, grey, self._in_view(photo, grey, view)))

    def _search(
        self, photo: UInt8[np.ndarray, "h w 3"], grey: UInt8[np.ndarray, "h w"], focal: float | None
    ) -> _Choice:
        height, width = grey.shape
        whole = self._in_view(photo, grey, fit_photo(photo, PhotoCamera(focal)).placement)
        if whole.judged.value >= _SURE and is_alike(width, height):
            return replace(self._given(photo, grey, whole), needed=_SURE)
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
        value, best = max(((_rated(one, tried, photo), one) for one in tried.values()), key=lambda pair: pair[0])
        seen = self._asked(photo, grey, best)
        believed = (_agreed(seen, tried, photo) >= _AGREED) | np.array(seen.judged.supported, bool)
        return _Choice(seen, value, _OF_MANY, believed, needed=_OF_MANY[0])

    def _try(self, tried: dict[Placement, _ViewLanes], photo, grey, camera: PhotoCamera) -> None:
        if camera.horizon is not None and camera.horizon <= 1.0:
            return  # at the upper border of the photo
        view = fit_photo(photo, camera).placement
        if view not in tried:
            tried[view] = self._in_view(photo, grey, view)

    def _given(self, photo, grey, seen: _ViewLanes, least: float = _GIVEN[0]) -> _Choice:
        """Return the choice of a view without alternatives, all of whose lanes are believed."""
        asked = self._asked(photo, grey, seen)
        return _Choice(asked, seen.judged.value, (least, _GIVEN[1]), np.ones(len(asked.lanes), bool))

    def _asked(self, photo, grey, seen: _ViewLanes) -> _ViewLanes:
        """Return the lanes of a view by the reader's threshold, which has no influence on how views are judged."""
        return seen if self.threshold == _JUDGED_SCORE else self._in_view(photo, grey, seen.view, self.threshold)

    def _in_view(self, photo, grey, view: Placement, threshold: float = _JUDGED_SCORE) -> _ViewLanes:
        fitted = fit_photo(photo, view)
        example = RoadImage(fitted.image, fitted.image_valid, LaneLines.empty(1, 1))
        stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], example)
        answer = row_of(predict_curves(self.task, self.params, stacked), 0)
        scores = np.asarray(answer.scores)
        curves = np.asarray(answer.curves, np.float64)
        # A lane that would end above its beginning has no points, as in TuSimple's metric.
        chosen = np.flatnonzero((scores >= threshold) & (curves[:, 1] > curves[:, 0]))
        chosen = chosen[order_from_left(curves[chosen])]
        curves, scores = curves[chosen], scores[chosen]
        rows = np.linspace(curves[:, 0], curves[:, 1], _POINTS, axis=-1)
        lanes = list(np.stack([curve_columns(curves[:, 2:], rows), rows], -1))
        points = [_inside(view.to_photo(lane), grey.shape, view.top + HORIZON * view.height) for lane in lanes]
        return _ViewLanes(view, lanes, points, scores, judge_lanes(grey, view, lanes, scores))

    def _checked(self, photo: UInt8[np.ndarray, "h w 3"], choice: _Choice, horizon: float | None = None) -> PhotoLanes:
        """Return what is plausible, in pixels of the photo: below the horizon, inside, not crossing.

        Args:
            photo: the photo.
            choice: the view.
            horizon: of a known camera, row.
        """
        seen, judged, (least, plausible) = choice.seen, choice.seen.judged, choice.bounds
        if choice.value < least:
            return PhotoLanes(seen.view, (), (), (), choice.value, _NOTHING, choice.needed)
        # Lanes meet above their view's horizon where the road rises. Those of a known camera may be nearly parallel and
        # meet anywhere.
        top = seen.view.top + HORIZON * seen.view.height if horizon is None else horizon
        if horizon is None and judged.meeting is not None and not judged.crossed:
            top = min(top, judged.meeting[1])
        believed = np.flatnonzero(choice.believed).tolist()
        points = {i: _inside(seen.view.to_photo(seen.lanes[i]), photo.shape, top) for i in believed}
        inside = [i for i in believed if len(points[i]) > 1]
        worth = [float(seen.scores[i]) + judged.paint[i] for i in inside]
        clear = without_crossings([points[i] for i in inside], worth, seen.view.width)
        shown = [i for i, keep in zip(inside, clear, strict=True) if keep]
        warnings = [] if horizon is None else misfits(seen.view, horizon)
        if len(inside) < len(believed):
            lost = len(believed) - len(inside)
            warnings.append(f"{lost} of {len(believed)} lanes lie above the horizon or outside")
        if not clear.all():
            warnings.append(f"lanes that cross others are left out ({int((~clear).sum())})")
        if judged.crossed and clear.all():
            warnings.append("the lanes would cross before the horizon")
        if seen.lanes and choice.value < plausible and not judged.crossed:
            warnings.append("the lanes hardly lie on paint or do not meet on the horizon: look at the picture")
        return PhotoLanes(
            view=seen.view,
            lanes=tuple(points[i] for i in shown),
            scores=tuple(float(seen.scores[i]) for i in shown),
            paint=tuple(judged.paint[i] for i in shown),
            value=choice.value,
            warning="; ".join(warnings),
            needed=choice.needed,
        )


def _rated(one: _ViewLanes, tried: dict[Placement, _ViewLanes], photo: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the plausibility of one of many views; 0 where none of its lanes lies on paint."""
    if max(one.judged.paint, default=0.0) < _PAINTED:
        return 0.0
    return plausibility(one.judged.value, _agreed(one, tried, photo), one.points, photo.shape[0])


def _agreed(one: _ViewLanes, tried: dict[Placement, _ViewLanes], photo: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    """Return how much of each lane the other views show."""
    others = [other for view, other in tried.items() if view != one.view]
    values = [other.judged.value for other in others]
    return agreement(one.points, [other.points for other in others], values, photo.shape[:2])


def _inside(points: Float[np.ndarray, "p 2"], shape: tuple[int, ...], top: float) -> Float[np.ndarray, "q 2"]:
    """Return the points (column, row) in a photo of this shape and not above row `top`."""
    return points[inside_image(points, shape[1], shape[0]) & (points[:, 1] >= top)]


def _grey(photo: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    cv2 = opencv()
    return np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
