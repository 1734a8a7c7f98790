"""Names in natural order, and the times that they tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmr_cli.io.folders import natural, stem, times_by_name


@pytest.mark.parametrize(
    "names",
    [
        ["scan2", "scan10", "scan101"],
        ["99.5", "102.0", "102.05", "102.1"],  # decimal seconds, not chapters
        ["v1.2.9", "v1.2.10"],  # chapters, not decimals
        ["1317354879.05", "1317354879.1", "1317354880.0"],
        ["999999999950000000", "1000000000050000000"],
        ["a1", "A2", "a3"],
        ["3", "10", "¹²", "①1"],  # digits of other scripts are letters
    ],
)
def test_natural_order(names):
    assert sorted(reversed(names), key=natural) == names


def test_a_stem_is_what_is_left_without_the_format():
    names = ["102.05.ply", "7.bin", "1532402927.pcd.bin", "a.b.xyz.gz", ".ply"]
    assert [stem(Path("folder") / name) for name in names] == ["102.05", "7", "1532402927", "a.b", ".ply"]


@pytest.mark.parametrize(
    ("names", "seconds"),
    [
        (["102.0", "102.05", "102.1"], [102.0, 102.05, 102.1]),
        (["1317354879050000000", "1317354879150000000"], [1317354879.05, 1317354879.15]),
        (["1317354879050000", "1317354879150000"], [1317354879.05, 1317354879.15]),
        (["LIDAR_1317354879_050000000", "LIDAR_1317354879_150000000"], [1317354879.05, 1317354879.15]),
        (["000000", "000001"], None),  # the first, the second: no times
        (["0000000000", "0000000001"], None),  # KITTI's ten digits, neither
        (["a1.5", "b2.5"], None),
        (["1_2", "1_3"], None),
        (["①", "②"], None),
        ([], None),
    ],
)
def test_times_by_name(names, seconds):
    found = times_by_name(names)
    assert (found is None) == (seconds is None)
    if seconds is not None:
        assert np.abs(found - seconds).max() < 1e-6
