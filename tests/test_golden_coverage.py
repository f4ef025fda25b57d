"""Every golden file is claimed by a test."""

from fnmatch import fnmatchcase

import pytest

from tests.golden import CLAIMS, golden_entries
from tests.shared import ROOT, shared_path

pytestmark = pytest.mark.golden

# How a test asks for the cases of a folder of metrics.
METRICS = {
    "metrics/maptr": 'expected_cases("maptr")',
    "metrics/openlanev2_centerline": "expected_cases()",
    "metrics/openlanev2_lanesegment": 'expected_cases("lanesegment")',
    "metrics/resample": "golden/metrics/resample",
    "metrics/tusimple": '"metrics" / "tusimple"',
}


def asks_for(source, claim):
    """Return whether the source of a test file reads the cases of a claim."""
    return METRICS.get(claim, f'golden_modules("{claim.removeprefix("modules/")}")') in source


@pytest.mark.parametrize("claim", CLAIMS)
def test_every_claim_names_an_existing_test_and_golden_file(claim):
    shared_path("golden")
    assert asks_for((ROOT / CLAIMS[claim]).read_text("utf-8"), claim), f"{CLAIMS[claim]} does not read {claim}"
    assert any(fnmatchcase(name, claim) for name in golden_entries()), f"nothing under golden/ matches {claim}"


def test_every_golden_file_is_claimed():
    shared_path("golden")
    unclaimed = [name for name in golden_entries() if not any(fnmatchcase(name, claim) for claim in CLAIMS)]
    assert not unclaimed, f"write a test for each and name it in tests.golden.CLAIMS: {', '.join(unclaimed)}"
