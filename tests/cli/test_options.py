"""The options of a registration on the command line: those of ``Options``, refused on one line."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cli.options import takes_registration_options
from fmr_cli.registration.options import Options


def test_the_defaults_are_the_librarys():
    given = []

    @takes_registration_options
    def command(options: Options) -> None:
        given.append(options)

    command(**{f.name: f.default for f in fields(Options)})
    assert given == [Options()]


def test_every_option_arrives(fmr, monkeypatch):
    from fmr_cli.registration import pipeline

    class SeenError(Exception):
        pass

    def align(source, target, options, **_):
        raise SeenError(options)

    monkeypatch.setattr(pipeline, "align", align)
    with pytest.raises(SeenError) as seen:
        fmr(
            "align", "scan_a.ply", "scan_b.ply", "--init", "search", "--voxel-size", 0.5, "--no-normalize",
            "--points", 99, "--dof", "yaw", "--up", 0, 1, 0, "--scale", "--max-angle", 5, "--max-shift", 6,
            "--iterations", 7, "--no-robust", "--no-refine", "--allow-mirror",
            "--model", "m.safetensors", "--device", "cpu", "--seed", 8,
        )  # fmt: skip
    assert seen.value.args[0] == Options(
        init="search", voxel_size=0.5, normalize=False, points=99, dof="yaw", up=(0, 1, 0), scale=True, max_angle=5,
        max_shift=6, iterations=7, robust=False, refine=False, allow_mirror=True,
        model=Path("m.safetensors"), device="cpu", seed=8,
    )  # fmt: skip
    changed = [f.name for f in fields(Options) if getattr(seen.value.args[0], f.name) != f.default]
    with pytest.raises(SeenError) as seen:
        fmr("align", "scan_a.ply", "scan_b.ply", "--unit", "mm:m")  # which does without --scale and a given --init
    assert seen.value.args[0] == Options(unit="mm:m")
    assert {*changed, "unit"} == {f.name for f in fields(Options)}, "an option is missing above"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--voxel-size", 0), "fmr: --voxel-size 0.0: is too small, give more than 0"),
        (("--voxel-size", "nan"), "fmr: --voxel-size nan: is no finite number"),
        (("--points", 9), "fmr: --points 9: is too small, give 10 or more"),
        (("--up", 0, 0, 0), "fmr: --up (0.0, 0.0, 0.0): is no direction; give three finite numbers, not all zero"),
        (("--unit", "mm"), "fmr: --unit mm: give the source's and the target's, such as mm:m, of m, mm, cm"),
        (("--unit", "mm:m", "--scale"), "fmr: --unit mm:m: leave it out with --scale"),
        (("--init", "feature"), "fmr: feature: is no start (auto, search, features, centroid, identity) and no "),
        (("--init", "twice.txt"), "fmr: --init: its transform scales by 2; add --scale, or give a rigid motion"),
    ],
)
def test_a_wrong_value_is_one_line(fmr, tmp_path, arguments, said):
    np.savetxt(tmp_path / "twice.txt", np.diag([2.0, 2.0, 2.0, 1.0]))
    done = fmr("align", "a.ply", "b.ply", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(said)
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(("name", "known"), [("dof", "planar"), ("device", "cuda")])
def test_an_unknown_word_names_the_choices(fmr, name, known):
    done = fmr("align", "a.ply", "b.ply", f"--{name}", "other")
    assert done.returncode == 2
    assert known in done.stderr
