"""`align_sequence`: from Python, with files or without, cut off and gone on with."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fmr_cli.errors import FmrError
from fmr_cli.io import read_cloud, read_poses
from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans


class CutError(Exception):
    """Stands for whatever ends a process."""


def cut_after(frames):
    def on_row(row, done, total):
        if done == frames:
            raise CutError

    return on_row


def test_without_files_named_it_writes_none_and_gives_the_same_poses(street, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder, truth = street
    scans = find_scans(folder, stop=4)
    in_memory = align_sequence(scans)
    assert list(tmp_path.iterdir()) == []
    assert in_memory.status == "aligned"
    assert np.abs(in_memory.poses[:, :3, 3] - truth[:4, :3, 3]).max() < 0.03
    align_sequence(scans, tmp_path / "p.txt")
    assert np.array_equal(read_poses(tmp_path / "p.txt"), in_memory.poses)


def test_clouds_files_and_a_folder_are_one_sequence(street):
    folder, _ = street
    files = [folder / f"{i}.bin" for i in range(4)]
    by_folder = align_sequence(find_scans(folder, stop=4))
    assert np.array_equal(align_sequence(files).poses, by_folder.poses)
    by_clouds = align_sequence([read_cloud(file) for file in files])
    assert np.array_equal(by_clouds.poses, by_folder.poses)
    assert [row["file"] for row in by_clouds.rows] == [f"{i}.bin" for i in range(4)]


def test_each_row_is_told_with_its_place(street):
    told = []
    align_sequence(find_scans(street[0], stop=3), on_row=lambda row, *place: told.append((row["frame"], *place)))
    assert told == [(0, 1, 3), (1, 2, 3), (2, 3, 3)]


@pytest.mark.parametrize(
    ("kind", "options"),
    [("street", SequenceOptions()), pytest.param("moving", SequenceOptions(deskew=True), marks=pytest.mark.slow)],
    ids=["plain", "deskewed"],
)
def test_cut_off_and_gone_on_with_it_comes_to_the_same_poses_and_the_same_map(request, tmp_path, kind, options):
    scans = find_scans(request.getfixturevalue(kind)[0], stop=5)
    whole = align_sequence(scans, tmp_path / "whole.txt", options, merged=tmp_path / "whole.ply")
    out, merged = tmp_path / "cut.txt", tmp_path / "cut.ply"
    with pytest.raises(CutError):
        align_sequence(scans, out, options, merged=merged, on_row=cut_after(3))
    assert len(read_poses(out)) == 3
    told = []
    align_sequence(scans, out, options, merged=merged, resume=True, on_row=lambda row, done, total: told.append(done))
    assert told == [4, 5]
    assert np.array_equal(read_poses(out), whole.poses)
    assert np.array_equal(read_cloud(merged).points, read_cloud(tmp_path / "whole.ply").points)
    assert not (tmp_path / "cut.txt.journal").exists()


def test_a_run_begun_otherwise_is_not_gone_on_with(street, tmp_path):
    scans = find_scans(street[0], stop=3)
    with pytest.raises(CutError):
        align_sequence(scans, tmp_path / "p.txt", on_row=cut_after(1))
    with pytest.raises(FmrError, match=r"begun with other settings \(voxel_size\)"):
        align_sequence(scans, tmp_path / "p.txt", SequenceOptions(voxel_size=1.0), resume=True)
    header = json.loads((tmp_path / "p.txt.journal").read_text().splitlines()[0])
    (tmp_path / "p.txt.journal").write_text(json.dumps({k: v for k, v in header.items() if k != "beginning"}) + "\n")
    with pytest.raises(FmrError, match="begun by another version of fmr, leave out --resume"):
        align_sequence(scans, tmp_path / "p.txt", resume=True)
    (tmp_path / "p.txt.journal").write_text("{\n")
    with pytest.raises(FmrError, match="is damaged"):
        align_sequence(scans, tmp_path / "p.txt", resume=True)


def test_resume_without_a_file_to_go_on_with_is_refused(street):
    with pytest.raises(FmrError, match="resume needs a file of poses"):
        align_sequence(find_scans(street[0], stop=3), resume=True)


def test_one_scan_is_no_sequence(street):
    with pytest.raises(FmrError, match="two or more"):
        align_sequence([street[0] / "0.bin"])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"format": "kiti"}, "format 'kiti': is not known, use one of kitti, tum, json"),
        ({"voxel_size": -1.0}, "voxel_size -1.0: must be more than 0"),
        ({"merged_voxel": float("nan")}, "merged_voxel nan: must be more than 0"),
    ],
)
def test_options_that_mean_nothing_are_refused_where_they_are_made(given, says):
    with pytest.raises(FmrError, match=says):
        SequenceOptions(**given)


def test_what_train_has_learnt_is_what_a_sequence_works_with(street, tmp_path):
    from dataclasses import replace

    from fmr_cli.io.weights import weights_bytes
    from fmr_cli.registration.models import model

    scans, own = find_scans(street[0], stop=3), tmp_path / "own.safetensors"
    layers = [(weight, bias * 0) for weight, bias in model().weights.layers]
    own.write_bytes(weights_bytes(replace(model().weights, layers=layers, local={})))
    bundled, other = (align_sequence(scans, options=SequenceOptions(model=path)) for path in (None, own))
    assert [row["status"] for row in other.rows] == ["aligned"] * 3
    assert all(
        a["feature_error_before"] != b["feature_error_before"]
        for a, b in zip(bundled.rows[1:], other.rows[1:], strict=True)
    )


def test_a_model_that_is_not_there_is_said_before_anything_is_written(street, tmp_path):
    with pytest.raises(FmrError, match=r"none.safetensors"):
        align_sequence(street[0], tmp_path / "p.txt", SequenceOptions(model=tmp_path / "none.safetensors"))
    assert not (tmp_path / "p.txt").exists()
