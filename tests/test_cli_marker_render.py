"""`tflane markers render`: a drive of the built-in world, and what it refuses."""

import datetime

import pytest

from tests.markers.test_reader import STORE
from tflane_jax.cli import main
from tflane_jax.commands import marker_render

pytest.importorskip("cv2")


def test_the_rendered_store_has_the_day_of_its_survey(tmp_path, monkeypatch):
    monkeypatch.setattr(marker_render, "render_cameras", lambda *_: pytest.fail("drawn"))
    written = []
    monkeypatch.setattr(marker_render, "store_of_log", lambda log, **options: written.append(options) or STORE)
    with pytest.raises(pytest.fail.Exception, match="drawn"):
        main(["markers", "render", "--log", "200000005", "--surveyed", "2026-01-15", "--out", str(tmp_path / "town")])
    assert written[0]["surveyed"] == datetime.date(2026, 1, 15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--log", "-1"], "--log"),
        (["--cameras", "0"], "--cameras is 1 to 7"),
        (["--cameras", "-1"], "--cameras is 1 to 7"),
        (["--cameras", "7", "--ring", "nuscenes"], "--cameras is 1 to 6, the cameras of --ring nuscenes"),
        (["--frames", "0"], "--frames must be from 1"),
        (["--frames", "100000000000000"], "--frames must be from 1"),
        (["--surveyed", "soon"], "--surveyed soon is no day"),
        (["--scale", "50"], "--scale is 50.0: it must be so small that images have at most 8192 pixels"),
    ],
)
def test_render_refuses_what_it_cannot_draw(tmp_path, capsys, change, words):
    arguments = ["markers", "render", "--log", "1", "--out", str(tmp_path / "out"), *change]
    assert main(arguments) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_drives_do_not_share_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(marker_render, "simulate", lambda *_: pytest.fail("simulated"))
    (tmp_path / "images").mkdir()
    assert main(["markers", "render", "--log", "1", "--out", str(tmp_path)]) == 2
    assert "is not empty: choose another folder" in capsys.readouterr().err
