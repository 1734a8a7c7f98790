"""Which pairs are tried where looks have failed: first those that resemble each other as places."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from fmr_cli.multiway.candidates import alike_first
from fmr_cli.multiway.looks import similarity


def test_pairs_that_resemble_each_other_as_places_come_first():
    rng = np.random.default_rng(0)
    descriptors = [rng.normal(size=(300, 8)) for _ in range(3)]
    descriptors.append(descriptors[0] + rng.normal(0, 0.05, (300, 8)))  # scan 3 shows what scan 0 shows
    survey = SimpleNamespace(
        edges=dict.fromkeys(range(4), 1.0),
        similarity=similarity([SimpleNamespace(descriptors=found) for found in descriptors]),
    )
    pairs = [(1, 0), (2, 0), (2, 1), (3, 0), (3, 1), (3, 2)]
    assert alike_first(survey, pairs)[0] == (3, 0)
    assert sorted(alike_first(survey, pairs)) == pairs
