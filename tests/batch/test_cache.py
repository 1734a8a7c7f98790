"""The cache of prepared files: bounded, and never a file made otherwise than asked for."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud, write_cloud
from fmr_cli.batch.cache import CloudCache
from fmr_cli.errors import CloudFileError


@pytest.fixture
def folder(tmp_path):
    """Three files of 100 points."""
    for name in "abc":
        write_cloud(tmp_path / f"{name}.ply", PointCloud(np.random.default_rng(0).normal(size=(100, 3))))
    return tmp_path


def test_it_lets_go_of_what_was_used_longest_ago(folder):
    cache = CloudCache(at_most=250)
    for name in "abac":
        cache.get(folder / f"{name}.ply", seed=0)
    assert [key.path.stem for key in cache.files] == ["a", "c"]


def test_it_lets_go_of_what_no_pair_needs_any_more(folder):
    cache, a, b = CloudCache(), folder / "a.ply", folder / "b.ply"
    for path in (a, b):
        cache.get(path, seed=0)
    cache.let_go({b})
    assert [key.path for key in cache.files] == [a]


def test_another_seed_or_a_file_that_was_changed_is_another_entry(folder):
    cache, path = CloudCache(), folder / "a.ply"
    plain = cache.get(path, seed=0)
    assert cache.get(path, seed=0) is plain
    assert cache.get(path, seed=1) is not plain
    write_cloud(path, PointCloud(np.random.default_rng(1).normal(size=(90, 3))))
    assert cache.get(path, seed=0).said.count == 90


def test_a_file_that_cannot_be_read_says_so_each_time(folder):
    cache = CloudCache()
    for _ in range(2):
        with pytest.raises(CloudFileError, match="no such file"):
            cache.get(folder / "nowhere.ply", seed=0)
