"""Which scans, in which order, at which times."""

from __future__ import annotations

import numpy as np

from fmr_cli.sequence.scans import find_scans


def folder_of(tmp_path, names):
    for name in names:
        (tmp_path / f"{name}.bin").write_bytes(b"")
    return tmp_path


def test_names_that_are_times_are_sorted_as_numbers_and_are_the_times(tmp_path):
    found = find_scans(folder_of(tmp_path, ["102.0", "102.05", "102.1", "99.5"]), start=1)
    assert [path.stem for path in found.sources] == ["102.0", "102.05", "102.1"]
    assert np.allclose(found.times, [102.0, 102.05, 102.1])


def test_digits_of_other_scripts_are_names(tmp_path):
    found = find_scans(folder_of(tmp_path, ["①1", "²", "10", "9"]))
    assert [path.stem for path in found.sources] == ["9", "10", "²", "①1"]
    assert found.times is None


def test_a_list_may_run_backwards_but_not_to_and_fro(tmp_path):
    folder_of(tmp_path, ["1.0", "2.0", "3.0"])
    listed = tmp_path / "scans.lst"
    listed.write_text("3.0.bin\n2.0.bin\n1.0.bin\n")
    assert np.array_equal(find_scans(listed).times, [3.0, 2.0, 1.0])
    listed.write_text("1.0.bin\n3.0.bin\n2.0.bin\n")
    found = find_scans(listed)
    assert found.times is None
    assert "2.0.bin: time runs the other way there" in found.notes[0]
