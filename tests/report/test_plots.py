"""The style of plots: intervals by the book, names that don't meet, pictures in each format."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmr_cli.report import plots

pytest.importorskip("matplotlib")


@pytest.mark.parametrize(("hits", "count"), [(0, 6), (3, 10), (40, 40), (1, 1000)])
def test_intervals_are_wilsons(hits, count):
    """Its ends are the shares that lie 1.96 of their own standard deviations from what was counted."""
    share = hits / count
    low, high = plots.binomial(share, count)
    assert low <= share <= high
    assert low < high
    for end in (low, high):
        assert abs(share - end) == pytest.approx(1.96 * np.sqrt(end * (1 - end) / count), abs=1e-4)


@given(st.lists(st.floats(-100, 100), max_size=12).map(sorted))
def test_names_stand_apart_and_where_they_belong(wanted):
    found = plots.spread(np.array(wanted), 5.0)
    assert (np.diff(found) >= 5 - 1e-9).all()
    if len(wanted) and (np.diff(wanted) >= 5).all():
        np.testing.assert_allclose(found, wanted, atol=1e-9)
    if wanted:
        assert found.mean() == pytest.approx(np.mean(wanted), abs=1e-6)  # as near to them as together possible


@pytest.mark.parametrize(("suffix", "begin"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_a_pair_as_a_picture(pair, tmp_path, suffix, begin):
    from fmr_cli.report.picture import write_picture

    write_picture(tmp_path / f"p{suffix}", *pair)
    assert (tmp_path / f"p{suffix}").read_bytes().startswith(begin)


def test_lines_that_coincide_both_show(tmp_path):
    """Two equal lines: both colours are in the picture."""
    from matplotlib.image import imread

    x = [0.0, 1.0, 2.0]
    with plots.figure(tmp_path / "c.png", 4, 3) as figure:
        plots.curves(figure.subplots(), [plots.Series("a", x, [1.0] * 3), plots.Series("b", x, [1.0] * 3)], dodge=0.01)
    pixels = (255 * imread(tmp_path / "c.png")[..., :3]).round().astype(int)
    for color in plots.COLORS[:2]:
        rgb = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(pixels - rgb).max(2) < 8).sum() > 100
