"""The search for the part of a photo that suits the network, with a network that knows the road."""

import numpy as np
import pytest

from tests.evaluation.test_photo_lanes import FEET, road
from tflane_jax.datasets.photos import FOCAL, HORIZON, PhotoCamera, Placement
from tflane_jax.errors import UserError
from tflane_jax.scene import CurvePrediction
from tflane_jax.tasks import photo_lanes
from tflane_jax.tasks.photo_lanes import PhotoReader

cv2 = pytest.importorskip("cv2")
TRUE = Placement(400, 300, 800, 450)


def curves(feet, horizon, ahead=0.5, upper=None):
    """Return straight lanes as LSTR's numbers: u = b v - b''' below the horizon."""
    rows = []
    for foot in feet:
        slope = (foot - ahead) / (1.0 - horizon)
        rows.append([horizon if upper is None else upper, 1.0, 0, 0.2, 0, 0, slope, slope * horizon - ahead])
    return np.array(rows)


def in_view(view, pixels):
    """Return columns and rows of the photo as fractions of the view: `Placement.to_photo` backwards."""
    return (pixels - (view.left, view.top)) / (view.width, view.height)


@pytest.fixture
def network(monkeypatch):
    """Answer every view with the lanes that it shows: straight ones through the horizon of the drawn road."""
    answers = {"scores": 0.9, "views": []}

    def predict(task, params, examples):
        view = answers["views"][-1]
        ahead, horizon = in_view(view, TRUE.to_photo(np.array([0.5, HORIZON])))
        feet = in_view(view, TRUE.to_photo(np.stack([FEET, np.ones(4)], -1)))
        # The lanes' columns at the lower end of the view.
        at_end = ahead + (feet[:, 0] - ahead) * (1.0 - horizon) / (feet[:, 1] - horizon)
        logit = np.log(answers["scores"] / (1.0 - answers["scores"]))
        logits = np.stack([np.zeros(4), np.broadcast_to(logit, 4)], -1)
        upper = answers.get("upper", max(horizon, 0.0))
        return CurvePrediction(logits[None], curves(at_end, horizon, ahead, upper)[None])

    fit = photo_lanes.fit_photo

    def fit_photo(photo, camera=None):
        fitted = fit(photo, camera)
        answers["views"].append(fitted.placement)
        return fitted

    monkeypatch.setattr(photo_lanes, "predict_curves", predict)
    monkeypatch.setattr(photo_lanes, "fit_photo", fit_photo)
    return answers


def photo(view=TRUE, size=(900, 1600)):
    grey = road(view=view, size=size)
    grey[: view.top] = np.linspace(140, 220, size[1]).astype(np.uint8)  # a sky
    return np.repeat(grey[..., None], 3, -1)


def reader(threshold=0.5):
    return PhotoReader(None, {}, threshold)


def test_the_view_is_found_in_which_the_lanes_meet_on_the_horizon(network):
    found = reader().read(photo())
    horizon = TRUE.top + HORIZON * TRUE.height
    assert found.view.top + HORIZON * found.view.height == pytest.approx(horizon, abs=12)
    assert len(found.lanes) >= 2
    assert (found.warning, found.needed) == ("", 0.72)
    for points in found.lanes:
        u, v = points.T
        assert v.min() >= horizon - 12
        assert ((u >= 0) & (u < 1600) & (v < 900)).all()
    assert len(set(network["views"])) > 15


def test_tusimples_own_view_needs_no_search(network, monkeypatch):
    whole = Placement(0, 0, 1280, 720)
    monkeypatch.setitem(globals(), "TRUE", whole)
    found = reader().read(photo(whole, (720, 1280)))
    assert (found.view, found.warning, len(found.lanes), found.needed) == (whole, "", 4, 0.2)
    assert set(network["views"]) == {whole}


def test_a_portrait_is_searched_however_plausible_it_looks(network, monkeypatch):
    """Stretched to 16:9, it is not what TuSimple's camera would have seen."""
    whole = Placement(0, 0, 405, 720)
    monkeypatch.setitem(globals(), "TRUE", whole)
    reader().read(photo(whole, (720, 405)))
    assert len(set(network["views"])) > 15


def test_a_known_camera_is_not_searched(network):
    assert reader().read(photo(), PhotoCamera(horizon=449)).needed is None
    assert len(set(network["views"])) == 1
    with pytest.raises(UserError, match="below a photo"):
        reader().read(photo(), PhotoCamera(horizon=900))


def test_a_known_camera_that_gives_no_view_like_tusimples_is_a_warning(network):
    assert reader().read(photo(), PhotoCamera(horizon=449)).warning == ""
    assert "distorted to 16:9" in reader().read(photo(), PhotoCamera(horizon=880)).warning


def test_the_horizon_is_searched_for_a_known_focal_length(network):
    """Without it, the photo would be seen with the horizon of TuSimple, 150 rows too high."""
    focal = FOCAL * TRUE.width
    found = reader().read(photo(), PhotoCamera(focal=focal))
    horizon = TRUE.top + HORIZON * TRUE.height
    assert found.view.top + HORIZON * found.view.height == pytest.approx(horizon, abs=12)
    assert (found.view.width, found.warning, len(found.lanes) >= 2) == (TRUE.width, "", True)
    assert {view.width for view in network["views"]} <= {TRUE.width, 1600}
    view = reader().find_view([photo()], focal)
    assert view is not None
    assert view.width == TRUE.width


@pytest.mark.parametrize("value", [0, 128, 255])
def test_empty_photos_have_no_lanes(network, value):
    found = reader().read(np.full((90, 160, 3), value, np.uint8))
    assert (found.lanes, found.warning) == ((), "the photo is empty: it has one brightness almost everywhere")
    assert reader().find_view([np.full((90, 160, 3), value, np.uint8)]) is None


def test_lanes_without_paint_are_a_warning(network):
    bare = np.repeat(np.tile(np.linspace(60, 200, 1600).astype(np.uint8), (900, 1))[..., None], 3, -1)
    found = reader().read(bare)
    assert (found.lanes, found.needed) == ((), 0.72)
    assert found.value < found.needed
    assert found.warning.startswith("no lanes: no part of the photo shows any that meet")
    assert "--horizon" in found.warning
    assert reader().find_view([bare]) is None


def test_photos_in_which_the_network_sees_nothing_are_a_warning(network):
    """As are frames of a video, in their one view; with a known camera no lane is an answer."""
    network["scores"] = 0.1
    for found in (reader().read(photo()), reader().read_view(photo(), TRUE)):
        assert found.lanes == ()
        assert found.warning.startswith("no lanes: no part of the photo shows any")
    known = reader().read(photo(), PhotoCamera(horizon=449))
    assert (known.lanes, known.warning) == ((), "")


def test_the_threshold_chooses_the_lanes(network):
    network["scores"] = np.array([0.95, 0.4, 0.7, 0.6])
    known = PhotoCamera(horizon=449)
    assert [len(reader(t).read(photo(), known).lanes) for t in (0.0, 0.5, 0.65, 0.99)] == [4, 3, 2, 0]
    assert sorted(reader(0.65).read(photo(), known).scores) == pytest.approx([0.7, 0.95])


def test_the_threshold_does_not_choose_the_view(network):
    network["scores"] = np.array([0.95, 0.4, 0.7, 0.6])
    found = {threshold: reader(threshold).read(photo()) for threshold in (0.1, 0.5, 0.65)}
    assert len({one.view for one in found.values()}) == 1
    assert len({one.value for one in found.values()}) == 1
    assert [sorted(one.scores) for one in found.values()] == [
        pytest.approx([0.4, 0.6, 0.7, 0.95]),
        pytest.approx([0.6, 0.7, 0.95]),
        pytest.approx([0.7, 0.95]),
    ]


def test_a_lane_that_ends_above_its_beginning_is_none(network):
    network["upper"] = 1.1  # of lanes that end at row 1
    found = reader().read(photo(), PhotoCamera(horizon=449))
    assert (found.lanes, found.warning) == ((), "")


def test_what_lies_above_the_horizon_is_cut(network):
    network["upper"] = 0.0
    found = reader().read(photo(), PhotoCamera(horizon=449))
    assert min(points[:, 1].min() for points in found.lanes) >= 449 - 12


@pytest.mark.parametrize("together", [1e-9, 1e-4, -1e-4, 0.02])
def test_nearly_parallel_lanes_are_cut_at_the_horizon_of_a_known_camera(monkeypatch, together):
    """They meet far above the photo or far below it, which says nothing of the horizon."""
    beside = np.array([0.2, 0.4, 0.6, 0.8])
    slopes, none = together * (beside - 0.5), np.zeros(4)
    lanes = np.stack([none, none + 1.0, none, none + 0.2, none, none, slopes, slopes - beside], -1)

    def predict(task, params, examples):
        return CurvePrediction(np.tile([0.0, 2.0], (1, 4, 1)), lanes[None])

    monkeypatch.setattr(photo_lanes, "predict_curves", predict)
    found = reader().read(photo(), PhotoCamera(horizon=449))
    assert len(found.lanes) == 4
    assert [points[:, 1].min() for points in found.lanes] == pytest.approx([453] * 4, abs=6)
    found = reader().read(photo(), PhotoCamera(focal=2000))
    assert (found.lanes, found.warning[:8]) == ((), "no lanes")


def test_frames_of_a_video_share_a_view(network):
    view = reader().find_view([photo(), np.zeros((900, 1600, 3), np.uint8)])
    assert view is not None
    before = len(network["views"])
    assert len(reader().read_view(photo(), view).lanes) >= 2
    assert set(network["views"][before:]) <= {view, Placement(0, 0, 1600, 900)}


def test_a_view_that_needs_no_search_is_that_of_a_video_too(network, monkeypatch):
    """Worn paint, on which no lane lies for certain: five of TuSimple's ten frames at hand are like this."""
    whole = Placement(0, 0, 1280, 720)
    monkeypatch.setitem(globals(), "TRUE", whole)
    grey = road(dashes=14)
    grey[:200] = 200  # a sky
    worn = np.repeat(grey[..., None], 3, -1)
    found = reader().read(worn)
    assert (found.view, len(found.lanes), max(found.paint) < 0.18) == (whole, 4, True)
    assert reader().find_view([worn]) == whole
