"""Clouds that lie elsewhere, by fsspec: read as files are, and what fails is one line with the address."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

fsspec = pytest.importorskip("fsspec")

from fmr_cli import PointCloud, read_cloud, write_cloud  # noqa: E402
from fmr_cli.batch import align_batch  # noqa: E402
from fmr_cli.errors import CloudFileError  # noqa: E402
from fmr_cli.io import addresses, open_cloud, scan_paths  # noqa: E402
from fmr_cli.multiway.scans import list_scans  # noqa: E402

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.fixture
def bucket(tmp_path: Path):
    """What is put there is at memory://bucket/NAME."""
    there = fsspec.filesystem("memory")

    def put(name: str, cloud: PointCloud) -> str:
        write_cloud(tmp_path / name, cloud)
        there.put(str(tmp_path / name), f"/bucket/{name}")
        return f"memory://bucket/{name}"

    yield put
    addresses.remove_copies()
    there.rm("/bucket", recursive=True)


@pytest.mark.parametrize("as_path", [str, Path])
def test_an_address_is_read_as_a_file(bucket, as_path: type) -> None:
    """A Path folds the slashes."""
    cloud = PointCloud(np.random.default_rng(0).random((50, 3)), {"q": np.arange(50)})
    address = bucket("a.las", cloud)
    back = read_cloud(as_path(address))
    assert np.abs(back.points - cloud.points).max() < 1e-8
    assert np.array_equal(back.attributes["q"], cloud.attributes["q"])
    assert open_cloud(as_path(address)).name == address
    assert scan_paths(address) == [Path(address)]


def test_only_some_copies_are_kept(bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addresses, "COPIES", 2)
    names = [bucket(f"{k}.ply", PointCloud(np.full((1, 3), k))) for k in range(4)]
    assert [read_cloud(name).points[0, 0] for name in names] == [0, 1, 2, 3]
    copies = [*addresses._copies.values()]
    assert [copy.name for copy in copies] == ["2.ply", "3.ply"]
    addresses.remove_copies()
    assert not any(copy.parent.exists() for copy in copies)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("memory://bucket/none.ply", "no such file, check the address"),
        ("nosuch://bucket/a.ply", "cannot be fetched (Protocol not known: nosuch)"),
        ("memory://bucket/a", "has no suffix"),
    ],
)
def test_what_fails_is_one_line_with_the_address(bucket, address: str, said: str) -> None:
    bucket("a.ply", PointCloud(np.zeros((1, 3))))
    with pytest.raises(CloudFileError) as error:
        read_cloud(Path(address))
    assert str(error.value).startswith(f"{address}: {said}")
    assert "\n" not in str(error.value)


def test_a_batch_and_a_list_name_addresses(tmp_path: Path) -> None:
    for name in ("a", "b"):
        cloud = read_cloud(SAMPLES / f"scan_{name}.ply")
        write_cloud(tmp_path / f"{name}.ply", cloud.select(slice(None, None, 8)))
    shutil.copy(SAMPLES / "truth.txt", tmp_path)
    there = [f"file://{tmp_path}/{name}.ply" for name in ("a", "b")]
    manifest = tmp_path / "pairs.csv"
    manifest.write_text(f"source,target,init\na.ply,b.ply,truth.txt\n{there[0]},{there[1]},truth.txt\n")
    rows = align_batch(manifest, tmp_path / "out", aligned=True, workers=1)
    assert rows[0]["status"] == rows[1]["status"] != "failed"
    for kind in ("transforms", "aligned"):
        first, second = sorted((tmp_path / "out" / kind).iterdir())
        assert first.read_bytes() == second.read_bytes()
    (tmp_path / "scans.txt").write_text("\n".join(there))
    assert [scan.name for scan in list_scans([tmp_path / "scans.txt"])] == ["a", "b"]
