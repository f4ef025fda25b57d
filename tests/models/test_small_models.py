"""The small configurations can represent what they are trained on: a capacity test, not one of generalisation."""

import json
import subprocess
import sys

import pytest

from tests.fast_compile import optimised
from tests.shared import ROOT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "group", "score"),
    [
        ("tf_lane/toponet", "all", "DET_l@1.0"),
        ("tf_lane/toponet:street", "all", "DET_l@1.0"),
        ("tf_lane/lanesegnet:street", "all", "AP_ls@1.0"),
        ("tf_lane/maptr:street", "lines", "mAP@1.0"),
        ("tf_lane/maptrv2:street", "lines", "mAP@1.0"),
    ],
)
def test_twenty_frames_are_learned_to_a_metre(name, group, score):
    command = [sys.executable, "-m", "tests.models.overfit", name]
    ended = subprocess.run(command, cwd=ROOT, env=optimised(), capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    scores = json.loads(ended.stdout)[group]
    assert scores[score] > 0.8, scores
