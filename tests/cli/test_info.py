"""`fmr info`: what is in a file, for a person and as JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

Fmr = Callable[..., object]

COUNTS = {
    "las/1.2-with-color.las": 1065,
    "las/autzen_trim.las": 110_000,
    "las/autzen_trim.laz": 110_000,
    "las/extrabytes.las": 1065,
    "las/mvk-thin.las": 6280,
    "las/simple.las": 1065,
    "las/test1_4.las": 1000,
    "objects/bed.off": 22_627,
    "objects/bunny_part1.xyz": 20_702,
    "objects/bunny_part2.xyz": 21_637,
    "objects/shapes/cow.ply": 4096,
}


@pytest.fixture(scope="module")
def said(shared_data: Path, fmr: Fmr) -> dict[str, dict]:
    """What one run of the command says about real scans, by the file's name."""
    scans = sorted([*shared_data.glob("hdl64/*.pcd"), *shared_data.glob("kitti_raw/*.bin")])[::4]
    files = [*COUNTS, *(str(path.relative_to(shared_data)) for path in scans)]
    done = fmr("info", *files, "--json", cwd=shared_data)
    assert (done.returncode, done.stderr) == (0, "")
    return {entry["file"]: entry for entry in json.loads(done.stdout)}


def test_every_real_file_has_the_right_count(said: dict[str, dict], shared_data: Path) -> None:
    assert {name: said[name]["points"] for name in COUNTS} == COUNTS
    scans = [name for name in said if name not in COUNTS]
    assert len(scans) == 7
    for name in scans:
        data = (shared_data / name).read_bytes()
        match = re.search(rb"POINTS (\d+)", data[:400])
        assert said[name]["points"] == (int(match[1]) if match else len(data) // 16)
        assert said[name]["attributes"] == {"intensity": "float32"}
        assert said[name]["sensor_origin"] == [0, 0, 0]
        assert 0.005 < said[name]["spacing"] < 0.2


def test_what_a_las_file_says(said: dict[str, dict]) -> None:
    autzen = said["las/autzen_trim.laz"]
    assert autzen["format"] == "laz"
    assert np.allclose(autzen["bounds"]["min"], [636001.76, 848935.20, 406.26])
    assert np.allclose(autzen["extent"], [1177.46, 562.70, 114.25])
    assert autzen["attributes"]["gps_time"] == "float64"
    assert autzen["attributes"]["red"] == "uint16"
    assert autzen["crs"].startswith('PROJCS["NAD_1983_HARN_Lambert')
    assert said["las/mvk-thin.las"]["crs"] == "EPSG:26995"
    assert said["las/simple.las"]["crs"] is None
    assert said["las/extrabytes.las"]["attributes"]["Colors"] == "3 x uint16"
    assert said["objects/bed.off"]["mesh"] == {"vertices": 22_627, "faces": 35_299}


def test_the_table_for_a_person(tmp_path: Path, fmr: Fmr) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3) * 0.5
    rows = np.vstack([grid, grid[:7], [[np.nan, 0, 0]]])  # some points twice
    np.save(tmp_path / "grid.npy", rows)
    done = fmr("info", "grid.npy", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    lines = {line.split()[0]: line.split(maxsplit=1)[-1] for line in done.stdout.splitlines()}
    assert lines["points"] == "71, 1 dropped (NaN or infinite)"
    assert lines["extent"] == "1.5 1.5 1.5"
    assert lines["spacing"].startswith("0.5 ")
    assert lines["attributes"] == "none"


def test_a_bad_file_is_one_line_and_the_others_are_told(tmp_path: Path, fmr: Fmr) -> None:
    np.save(tmp_path / "a.npy", np.eye(3))
    (tmp_path / "b.bin").write_bytes(bytes(17))
    done = fmr("info", "b.bin", "none.ply", "a.npy", "--json", cwd=tmp_path)
    assert done.returncode == 2
    first, second = done.stderr.splitlines()
    assert first.startswith("fmr: b.bin: holds 17 bytes")
    assert second == "fmr: none.ply: no such file, check the name"
    assert [entry["file"] for entry in json.loads(done.stdout)] == ["a.npy"]
