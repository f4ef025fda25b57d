"""Images of the ring cameras against projections by `geometry`."""

from dataclasses import replace

import numpy as np
import pytest

from tests.world.camera_scene import FRONT, LINES, RING, light, scene, street, to_ego
from tflane_jax.geometry.cameras import project
from tflane_jax.scene import RoadUser
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig
from tflane_jax.world.cameras.sensor import render_cameras, visible_elements
from tflane_jax.world.render.weather import FrontWeatherConfig, Sky
from tflane_jax.world.simulate import WorldConfig, simulate

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def empty_street():
    return render_cameras(scene(street(crossing=False)), 0, FRONT)


def pixels_of(views, points, camera=0):
    pixels, _, valid = project(points, views.intrinsics[camera], views.camera_from_ego[camera])
    assert valid.all()
    return pixels


def brightness(views, camera=0):
    return views.image[camera].astype(float).max(-1)


@pytest.mark.parametrize("y", LINES)
def test_paint_lies_where_geometry_projects_it(empty_street, y):
    """In every row, the middle of what is brighter than the road is the projection of the line's middle."""
    grey = brightness(empty_street)
    errors = []
    for x in np.arange(6.5, 22.0, 0.5):
        line, left, right = pixels_of(empty_street, to_ego([x] * 3, [y, y + 0.3, y - 0.3]))
        if not (left[0] > 0.0 and right[0] < grey.shape[1] and line[1] < grey.shape[0] - 1.0):
            continue
        row = int(line[1])
        # Where this row of pixels has its line: the line crosses the row half a pixel from the point at most.
        ahead = pixels_of(empty_street, to_ego([x + 0.5], [y]))[0]
        expected = line[0] + (row + 0.5 - line[1]) * (ahead[0] - line[0]) / (ahead[1] - line[1])
        first, last = int(left[0]), int(right[0]) + 1
        strip = grey[row, first:last]
        road = np.median(strip)
        assert strip.max() - road > 20.0
        weight = np.clip(strip - road - 0.4 * (strip.max() - road), 0.0, None)
        middle = (weight * (np.arange(first, last) + 0.5)).sum() / weight.sum()
        errors.append(middle - expected)
    assert len(errors) > 8
    assert np.abs(errors).max() < 0.7
    assert abs(np.mean(errors)) < 0.25


@pytest.mark.parametrize("pitch", [30.0, 90.0])
def test_a_camera_that_sees_only_ground_sees_the_road(pitch):
    """Regression: the sky was looked for in no pixel, which ended with an error of OpenCV."""
    down = replace(FRONT, cameras=(replace(NUSCENES_RING[0], pitch=pitch),))
    grey = brightness(render_cameras(scene(street()), 0, down))
    assert grey.min() > 0.0
    assert np.median(grey) == pytest.approx(
        np.median(brightness(render_cameras(scene(street()), 0, FRONT))[-40:]), rel=0.2
    )


def test_crossing_is_painted_between_its_corners():
    """Paint between the edges of the crossing, asphalt a metre before and behind it."""
    plain, marked = (render_cameras(scene(street(crossing=there)), 0, FRONT) for there in (False, True))
    added = brightness(marked) - brightness(plain)

    def most(x):
        pixels = pixels_of(marked, to_ego(np.full(80, x), np.linspace(-3.2, 3.2, 80)))
        column, row = pixels.astype(int).T
        inside = (column >= 0) & (column < added.shape[1])
        return added[row[inside], column[inside]].max()

    assert min(most(14.2), most(16.8)) > 40.0
    assert max(most(12.5), most(18.5)) < 15.0


def test_a_vehicle_hides_what_lies_behind_it(empty_street):
    """The line between the lanes vanishes behind the truck, and stays before it."""
    box = (14.0, 0.9, 7.0, 2.4, 3.2)
    truck = render_cameras(scene(street(crossing=False), [box], category=RoadUser.TRUCK), 0, FRONT)
    hidden, clear = (pixels_of(truck, to_ego([x], [0.0])).astype(int)[0] for x in (19.0, 8.0))
    changed = np.abs(truck.image[0].astype(int) - empty_street.image[0]).max(-1)
    assert changed[hidden[1], hidden[0]] > 30
    assert changed[clear[1], clear[0]] <= 2


def test_same_log_same_bits_whatever_other_cameras_there_are():
    world = WorldConfig(keyframes=1, duration_s=2.5)
    config = CameraRigConfig(severity=1.0)
    first, again = (render_cameras(simulate(20, world), 0, config) for _ in range(2))
    assert first.image.tobytes() == again.image.tobytes()
    alone = render_cameras(simulate(20, world), 0, replace(config, cameras=NUSCENES_RING[4:5]))
    np.testing.assert_array_equal(alone.image[0], first.image[4])
    assert render_cameras(simulate(21, world), 0, config).image.tobytes() != first.image.tobytes()
    first.validate()


def test_severity_zero_has_no_weather():
    clear, stormy = (scene(street(), weather=w, paint_wear=w) for w in (0.0, 1.0))
    expected = render_cameras(clear, 0, RING)
    np.testing.assert_array_equal(render_cameras(stormy, 0, RING).image, expected.image)
    fog = FrontWeatherConfig(kinds=((Sky.CLEAR, 0.0), (Sky.FOG, 1.0)))
    foggy = render_cameras(stormy, 0, replace(RING, severity=1.0, weather=fog))
    sky = slice(0, 20)
    assert foggy.image[0, sky].std() < 0.5 * expected.image[0, sky].std() + 6.0
    assert np.abs(foggy.image.astype(int) - expected.image).mean() > 15.0


def test_images_of_different_sizes_lie_in_the_corner():
    views = render_cameras(scene(street()), 0, replace(RING, cameras=ARGOVERSE2_RING[:2]))
    assert views.size.tolist() == [[155, 205], [205, 155]]
    assert views.image.shape == (2, 205, 205, 3)
    assert views.image[0, :, 155:].max() == views.image[1, 155:].max() == 0
    assert views.image[0, :, :155].mean() > 40.0


@pytest.mark.parametrize(("attribute", "channel"), [(1, 0), (2, 1)])
def test_a_light_shows_its_state_inside_its_box(attribute, channel):
    log = scene(street([light()]), element_attribute=np.array([[attribute]]))
    views, seen = render_cameras(log, 0, FRONT), visible_elements(log, 0, FRONT)
    assert seen.visible.tolist() == [True]
    image = views.image[0].astype(int)
    others = [c for c in (0, 1) if c != channel]
    shining = (image[..., channel] > 150) & (image[..., others].max(-1) < 0.75 * image[..., channel])
    dark = render_cameras(scene(street([light()]), element_attribute=np.array([[0]])), 0, FRONT)
    shining &= np.abs(image - dark.image[0]).max(-1) > 60
    rows, columns = np.nonzero(shining)
    assert len(rows) > 4
    (left, top), (right, bottom) = seen.box[0]
    assert left - 1.0 <= columns.min()
    assert columns.max() + 1 <= right + 1.0
    assert top - 1.0 <= rows.min()
    assert rows.max() + 1 <= bottom + 1.0
    # Red shines in the upper half of the housing, green in the lower one.
    assert (rows.mean() + 0.5 < 0.5 * (top + bottom)) == (attribute == 1)


def test_which_elements_are_seen():
    elements = [
        light(),
        light(y=1.75, yaw=0.0),
        light(x=-25.0),
        light(y=-40.0),
        light(x=50.0, z=2.5, y=-5.0),
        light(x=20.0, y=1.0, z=2.0, category=2, attribute=4),
    ]
    plain = visible_elements(scene(street(elements)), 0, FRONT)
    # Facing away, behind, outside of the image: not seen.
    assert plain.visible.tolist() == [True, False, False, False, True, True]
    assert (plain.box[plain.visible, 1] > plain.box[plain.visible, 0]).all()
    truck = scene(street(elements), [(12.0, 2.0, 7.0, 3.5, 3.4)], category=RoadUser.TRUCK)
    assert visible_elements(truck, 0, FRONT).visible.tolist() == [True, False, False, False, True, False]
    coarse = replace(FRONT, element_pixels=40.0)
    assert visible_elements(scene(street(elements)), 0, coarse).visible.tolist() == [True, *[False] * 4, True]
    smaller = visible_elements(scene(street(elements)), 0, replace(FRONT, scale=0.1))
    np.testing.assert_array_equal(smaller.visible, plain.visible)
    np.testing.assert_allclose(smaller.box[plain.visible] * 4.0, plain.box[plain.visible], atol=1e-6)


def test_no_elements_no_boxes():
    seen = visible_elements(scene(street()), 0, FRONT)
    assert (seen.box.shape, seen.visible.shape) == ((0, 2, 2), (0,))
