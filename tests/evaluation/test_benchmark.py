"""Methods on pairs: the figures by hand, failures that end nothing, the order whatever the workers."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.errors import CloudFileError
from fmr_cli.evaluation.benchmark import Estimate, Outcome, alone, outcomes, summarise
from fmr_cli.evaluation.datasets.pair import DataSet, Loaded, Pair, Within
from fmr_cli.evaluation.quoted import QUOTED, quoted
from fmr_cli.registration.models import fast_encoder
from fmr_cli.synthetic.shapes import others


def row(scene: str, right: bool, rre: float, rte: float, status: str = "aligned", seconds: float = 1.0) -> Outcome:
    return Outcome(scene, "s", "t", "m", right, rre, rte, np.nan, status, 0.9, seconds)


ROWS = [
    row("a", True, 1.0, 0.1),
    row("a", True, 3.0, 0.3, "uncertain"),
    row("a", True, 2.0, 0.2),
    row("a", False, 90.0, 5.0, seconds=9.0),
    row("b", True, 6.0, 0.6, "uncertain"),
    row("b", False, 80.0, 7.0, "uncertain"),
]


def test_3dmatchs_figures_are_means_over_scenes() -> None:
    """Recall (3/4 + 1/2) / 2; RRE: the medians 2 and 6; of three aligned, two are right; of four right, two aligned."""
    (found,) = summarise(ROWS, by_scene=True)
    assert found.recall == pytest.approx(0.625)
    assert found.recall_of_pairs == pytest.approx(4 / 6)
    assert (found.rre, found.rte) == pytest.approx((4.0, 0.4))
    assert found.precision == pytest.approx(2 / 3)
    assert found.share == pytest.approx(0.5)
    assert found.found == pytest.approx(0.5)
    assert found.seconds == 1.0


def test_kittis_are_over_all_pairs_and_means_of_what_is_right() -> None:
    (found,) = summarise(ROWS, by_scene=False)
    assert found.recall == found.recall_of_pairs == pytest.approx(4 / 6)
    assert (found.rre, found.rte) == pytest.approx((3.0, 0.3))


def test_a_method_without_a_verdict_has_none() -> None:
    (found,) = summarise([row("a", True, 1.0, 0.1, ""), row("a", False, 9, 9, "failed")], by_scene=False)
    assert np.isnan(found.precision)
    assert np.isnan(found.share)
    assert found.failed == 1
    assert found.recall == 0.5


def pairs(count: int) -> list[Pair]:
    """Shifts by 0, 1, 2, ...; the third cannot be read."""

    def load(number: int) -> Loaded:
        if number == 2:
            raise CloudFileError("scan 2: is empty")
        T = np.eye(4)
        T[0, 3] = number
        source = np.random.default_rng(number).normal(size=(30, 3))
        return Loaded(source, source + np.array([number, 0, 0]), T)

    return [Pair("scene", f"s{n}", f"t{n}", lambda n=n: load(n)) for n in range(count)]  # type: ignore[misc]


def test_no_pair_and_no_method_ends_the_others() -> None:
    def right(source: np.ndarray, target: np.ndarray) -> Estimate:
        T = np.eye(4)
        T[:3, 3] = target.mean(0) - source.mean(0)
        return Estimate(T, "aligned", 1.0)

    def broken(source: np.ndarray, target: np.ndarray) -> Estimate:
        raise ValueError("no\nidea")

    data = DataSet("d", pairs(6), Within(5, 0.1))
    found = [outcomes(pair, data, {"right": right, "broken": broken}) for pair in data.pairs]
    assert [rows[0].right for rows in found] == [True, True, False, True, True, True]
    assert found[2][0].message == "scan 2: is empty"
    assert {rows[1].message for rows in found[3:]} == {"ValueError: no idea"}
    assert {rows[1].status for rows in found} == {"failed"}


def test_the_solver_alone_finds_a_moderate_turn_in_the_clouds_own_unit() -> None:
    """Of a shape 700 units large, far from the origin, turned by 20 deg."""
    from fmr_cli.cloud import transform_points
    from fmr_cli.evaluation.datasets.modelnet40 import motion

    source = 700.0 * others(1, 2048, seed=3)[0].astype(float) + 5000
    T = motion(np.random.default_rng(0), 20, 100)
    target = transform_points(T, source)
    found = alone(fast_encoder(), 10, True, 0)(source, target)
    pair = Loaded(source, target, T)
    assert Within(5, share=0.02, centred=True)(found.T_target_source, pair)
    assert found.status == ""


def test_every_quoted_row_says_where_it_stands() -> None:
    assert {q.dataset for q in QUOTED} == {"3DMatch", "3DLoMatch", "KITTI", "ETH", "ModelNet40"}
    for q in QUOTED:
        assert "github.com/" in q.source or "arXiv:" in q.source
        assert q.recall is not None or q.rre is not None
    assert quoted("poses") == []
