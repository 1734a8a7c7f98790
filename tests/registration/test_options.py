"""Options are checked where they are made, and can be compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.errors import FmrError, OptionsError
from fmr_cli.registration.options import Options

QUARTER = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"init": "feature"}, r"--init 'feature': unknown, choose from auto, search, features, centroid, identity"),
        ({"dof": "planer"}, r"--dof 'planer': unknown, choose from rigid, yaw, translation, planar"),
        ({"dof": 3}, r"--dof 3: unknown"),
        ({"device": "gpu"}, r"--device 'gpu': unknown, choose from auto, cpu, cuda"),
        ({"init": None}, r"--init None: choose from auto"),
        ({"init": np.eye(3)}, r"--init: has the shape \(3, 3\)"),
        ({"init": np.eye(4)[:3]}, r"--init: has the shape \(3, 4\)"),
        ({"init": [[1, 2], [3]]}, r"--init .*: choose from auto, .*, or give a 4x4 transform"),
        ({"init": np.full((4, 4), np.nan)}, r"--init: has numbers that are not finite"),
        ({"init": QUARTER.T}, r"--init: its last row is not 0 0 0 1"),
        ({"init": np.diag([1.0, 1, -1, 1])}, r"--init: its 3x3 block is no rotation"),
        ({"init": np.eye(4) + np.eye(4, k=1) * [0, 1, 0, 0]}, r"--init: its 3x3 block is no rotation"),
        ({"init": np.diag([2.0, 2, 2, 1])}, r"--init: its transform scales by 2; add --scale"),
        ({"up": (0.0, 0.0, 0.0)}, r"--up .*: is no direction"),
        ({"up": (0.0, 1.0)}, r"--up .*: is no direction"),
        ({"up": (0.0, np.inf, 0.0)}, r"--up .*: is no direction"),
        ({"up": None}, r"--up None: is no direction"),
        ({"voxel_size": 0.0}, r"--voxel-size 0.0: is too small, give more than 0"),
        ({"voxel_size": np.nan}, r"--voxel-size nan: is no finite number"),
        ({"voxel_size": "1"}, r"--voxel-size '1': is no finite number"),
        ({"points": 9}, r"--points 9: is too small, give 10 or more"),
        ({"points": 10.5}, r"--points 10.5: is no whole number"),
        ({"points": None}, r"--points None: is no finite number"),
        ({"iterations": 0}, r"--iterations 0: is too small, give 1 or more"),
        ({"seed": -1}, r"--seed -1: is too small, give 0 or more"),
        ({"seed": True}, r"--seed True: is no finite number"),
        ({"max_angle": -1.0}, r"--max-angle -1.0: is too small"),
        ({"max_shift": np.inf}, r"--max-shift inf: is no finite number"),
        ({"refine": "no"}, r"--refine 'no': is neither true nor false"),
        ({"model": 3}, r"--model 3: is no path"),
    ],
)
def test_what_makes_no_sense_is_refused_on_one_line(given, said):
    with pytest.raises(OptionsError, match=said) as raised:
        Options(**given)
    assert len(str(raised.value).splitlines()) == 1
    assert isinstance(raised.value, FmrError)


def test_a_given_pose_is_kept_to_the_bit_and_compares_by_value():
    pose = QUARTER.copy()
    options = Options(init=pose)
    pose[:] = 0  # the caller's array is not the options'
    np.testing.assert_array_equal(np.array(options.init), QUARTER)
    assert options == Options(init=QUARTER.tolist()) == replace(options, seed=0)
    assert hash(options) == hash(Options(init=QUARTER))
    assert options != Options()
    assert options != Options(init=np.eye(4))


def test_a_scaled_pose_goes_with_scale():
    scaled = np.diag([2.0, 2.0, 2.0, 1.0])
    np.testing.assert_array_equal(np.array(Options(init=scaled, scale=True).init), scaled)


def test_numpys_numbers_and_names_of_files_become_plain():
    options = Options(
        seed=np.int64(3), voxel_size=np.float32(0.5), up=np.array([0.0, 2.0, 0.0]), model="m.safetensors",
        robust=np.bool_(False), max_angle=90,
    )  # fmt: skip
    assert (type(options.seed), type(options.voxel_size), type(options.max_angle)) == (int, float, float)
    assert (options.up, options.model, options.robust) == ((0.0, 2.0, 0.0), Path("m.safetensors"), False)
