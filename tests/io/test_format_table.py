"""docs/formats.md: each line of what is read is an example that is read rightly, and the other way about."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from benchmarks.corpus import Example, examples, points, scanned
from fmr_cli.io import WRITABLE, read_cloud

DOCS = (Path(__file__).parents[2] / "docs" / "formats.md").read_text("utf-8")
ELSEWHERE = {"COPC": "test_copc.py", "ROS 1 bag, ROS 2 bag, MCAP": "test_bags.py"}  # lines with tests of their own
EXAMPLES = examples()


def first_cells(title: str) -> list[str]:
    """The first column of the table below a heading."""
    section = DOCS.split(f"## {title}\n")[1].split("\n## ")[0]
    return [cell.strip() for cell in re.findall(r"^\| (.*?) \|", section, re.MULTILINE)][2:]


def test_every_line_has_an_example_and_every_example_a_line() -> None:
    lines = first_cells("What is read")
    assert len(set(lines)) == len(lines)
    covered = {example.row for example in EXAMPLES} | {*ELSEWHERE}
    assert {*lines} - covered <= (set() if find_spec("pye57") else {"E57"})
    assert covered <= {*lines}
    assert all((Path(__file__).parent / name).is_file() for name in ELSEWHERE.values())


def test_every_format_that_is_written_has_a_line() -> None:
    assert {suffix for cell in first_cells("What is written") for suffix in cell.split()} == {*WRITABLE}


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_an_example_is_read_rightly(tmp_path: Path, example: Example) -> None:
    path = tmp_path / example.name
    path.write_bytes(example.data)
    cloud = read_cloud(path, mesh_points=0)
    expected = scanned() if path.suffix == ".bin" else points()
    np.testing.assert_allclose(cloud.points, expected, rtol=0, atol=example.close)
    assert tuple(cloud.attributes) == example.attributes
    assert cloud.left_out == example.left_out
