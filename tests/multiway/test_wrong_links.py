"""A network with a tenth of its links made wrong comes out right, and its table names them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.multiway import network_with_wrong_links


@pytest.fixture(scope="module")
def found():
    return network_with_wrong_links(1, scans=12, links=40)


def test_a_tenth_of_wrong_links_does_no_harm_and_is_named(found):
    assert len(found.wrong) == 4
    assert found.network.whole
    assert {x for x in found.rejected} == found.wrong
    assert found.worst_shift < 0.02
    for link in found.network.links:
        if link.status == "rejected":
            assert "apart" in link.message or "elsewhere" in link.message


def test_the_right_ones_are_kept(found):
    kept = [link for link in found.network.links if link.status == "aligned"]
    assert len(kept) == 36
    assert np.isfinite([link.residual_shift for link in kept]).all()
    assert max(link.residual_shift for link in kept) < 0.05
