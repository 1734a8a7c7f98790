"""The cross-source experiment counts what it says: errors of a similarity, and the verdict against the truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fmr_cli.errors import RegistrationError
from fmr_cli.evaluation import cross_source
from fmr_cli.evaluation.catalogue import EXPERIMENTS
from fmr_cli.geometry.se3 import exp
from fmr_cli.synthetic.cross_source import CrossSourcePair


@pytest.fixture
def pair() -> CrossSourcePair:
    rng = np.random.default_rng(0)
    target = rng.uniform(-1, 1, (200, 3)) + np.array([5.0, 0, 0])
    T = exp(np.array([0.4, 0.8, -0.1, 3.0, 0, 0]))
    T[:3, :3] *= 7.0
    source = (target - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T
    return CrossSourcePair(source, target, T, 7.0, 2.0)


def similar(pair: CrossSourcePair, degrees: float, shift: float, scale: float) -> np.ndarray:
    """The true pose, then a similarity about the target's middle."""
    off = exp(np.array([0, 0, np.radians(degrees), 0, 0, 0]))
    off[:3, :3] *= scale
    middle = pair.target.mean(0)
    off[:3, 3] = middle + np.array([shift, 0, 0]) - off[:3, :3] @ middle
    return off @ pair.T_target_source


def answering(monkeypatch: pytest.MonkeyPatch, answer, status: str = "aligned") -> None:
    def align(source, target, options, threads):
        T = answer() @ np.diag([*[1.0 if options.scale else 1 / 7.0] * 3, 1.0])  # in the source's unit
        return SimpleNamespace(T_target_source=T, status=status)

    monkeypatch.setattr(cross_source, "align", align)


@pytest.mark.parametrize("known", [False, True])
def test_the_errors_are_those_of_the_similarity(monkeypatch, pair, known) -> None:
    answering(monkeypatch, lambda: similar(pair, 4.0, 0.05, 1.0 if known else 1.03))
    found = cross_source.registered(pair, known)
    assert found["error"][:2] == pytest.approx((4.0, 0.025), rel=1e-6)
    assert found["scale"] == pytest.approx(0.0 if known else 0.03, abs=1e-9)


def test_what_cannot_be_registered_is_half_a_turn_off(monkeypatch, pair) -> None:
    def refuse():
        raise RegistrationError("too small")

    answering(monkeypatch, refuse)
    found = cross_source.registered(pair, False)
    assert found["error"][0] == pytest.approx(180)
    assert not found["aligned"]


@pytest.mark.parametrize(
    ("off", "right"),
    [((4.0, 0.03, 1.01), True), ((6.0, 0, 1), False), ((0, 0.05, 1), False), ((0, 0, 1.03), False)],
)
def test_right_is_below_all_three_bounds(monkeypatch, pair, off, right) -> None:
    monkeypatch.setattr(cross_source, "cross_source_pair", lambda *_: pair)
    answering(monkeypatch, lambda: similar(pair, *off))
    row = cross_source.at_level(EXPERIMENTS["cross-source"], 0, 1, 2, 0)[0]
    assert (row.clouds, row.method, row.level) == ("onto a laser", "fmr align --scale", 0.5)
    assert (row.success, row.aligned_right, row.aligned_wrong) == (float(right), float(right), float(not right))


def test_an_uncertain_pose_counts_as_neither(monkeypatch, pair) -> None:
    monkeypatch.setattr(cross_source, "cross_source_pair", lambda *_: pair)
    answering(monkeypatch, lambda: pair.T_target_source, "uncertain")
    row = cross_source.at_level(EXPERIMENTS["cross-source"], 0, 0, 1, 0)[0]
    assert (row.success, row.aligned_right, row.aligned_wrong) == (1.0, 0.0, 0.0)
