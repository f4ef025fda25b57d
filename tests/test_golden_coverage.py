"""Every golden file is claimed by a test; the others are named in a skip message."""

from fnmatch import fnmatchcase

import pytest

from tests.golden import CLAIMS, golden_entries
from tests.shared import ROOT, shared_path

pytestmark = pytest.mark.golden


@pytest.mark.parametrize("claim", CLAIMS)
def test_every_claim_names_an_existing_test_and_golden_file(claim):
    shared_path("golden")
    assert (ROOT / CLAIMS[claim]).is_file(), f"{CLAIMS[claim]} is to check {claim} and does not exist"
    assert any(fnmatchcase(name, claim) for name in golden_entries()), f"nothing under golden/ matches {claim}"


def test_unclaimed_files_are_named():
    shared_path("golden")
    unclaimed = [name for name in golden_entries() if not any(fnmatchcase(name, claim) for claim in CLAIMS)]
    if unclaimed:
        pytest.skip(f"{len(unclaimed)} golden files that no test claims yet: {', '.join(unclaimed)}")
