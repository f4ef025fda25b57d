"""Every shape in the signatures of geometry, layers, models, priors and losses holds where hosts call them.

No number changes its type on the way, either: promotion is strict.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HOSTS = {
    "lane graphs": ["toponet"],
    "further lane graphs": [
        "toponet, every prior",
        "lanesegnet",
        "toponet, cameras",
        "bevformer_detr",
        "lanesegnet, areas",
    ],
    "vector maps": ["maptr", "maptrv2"],
    "lane shapes": ["transformer", "gtn", "gcn", "han"],
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTS)
def test_shapes_are_as_annotated(kind):
    command = [sys.executable, "-m", "tests.shape_checks", *HOSTS[kind]]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr[-4000:]
    assert found.stdout.splitlines() == HOSTS[kind]
