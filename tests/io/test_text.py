"""Text as people export it: each dialect is read rightly, or refused by a line that names the cause."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import command
import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io import read_cloud, write_cloud
from fmr_cli.io.describe import describe

# what the file says, how it is called; every one of these holds (1, 2.5, 3), (-4, 5, 600) and has these attributes
DIALECTS = {
    "blanks.xyz": ("1 2.5 3\n  -4   5\t600  \n", {}),
    "comma.csv": ("1,2.5,3\n-4,5,600\n", {}),
    "comma-blank.txt": ("1, 2.5, 3\n-4, 5, 600\n", {}),
    "semicolon.txt": ("1;2.5;3\n-4;5;600\n", {}),
    "trailing.txt": ("1;2.5;3;\n-4;5;600;\n", {}),
    "trailing-comma.csv": ("x,y,z,\n1,2.5,3,\n-4,5,600,\n", {}),
    "tab.txt": ("1\t2.5\t3\n-4\t5\t600\n", {}),
    "tab-empty.txt": ("x\ty\tz\tintensity\n1\t2.5\t3\t\n-4\t5\t600\t7\n", {"intensity": [np.nan, 7]}),
    "tab-trailing.txt": ("1\t2.5\t3\t\n-4\t5\t600\t\n", {}),
    "last-empty.csv": ("x;y;z;q\n1;2.5;3;\n-4;5;600;\n", {"q": [np.nan, np.nan]}),
    "pipe.txt": ("X|Y|Z\n1|2.5|3\n-4|5|600\n", {}),
    "decimal-semicolon.csv": ("X;Y;Z;Intensity\n1,0;2,5;3;0,5\n-4;5;600,0;7,25\n", {"intensity": [0.5, 7.25]}),
    "decimal-tab.txt": ("1,0\t2,5\t3,0\n-4,0\t5,0\t600,0\n", {}),
    "decimal-blanks.txt": ("1,0 2,5 3,0\n-4,0 5,0 600,0\n", {}),
    "decimal-blanks-fortran.txt": ("1,0 2,5 3,0\n-4,0 5,0 6,0D2\n", {}),  # numpy refuses it, cell by cell it is read
    "quotes.csv": ('"x","y","z","i"\n"1","2.5","3","9"\n"-4","5","600","8"\n', {"intensity": [9, 8]}),
    "units.csv": ("X [m],Y [m],Z [m],Intensity (counts)\n1,2.5,3,9\n-4,5,600,8\n", {"intensity": [9, 8]}),
    "units-blanks.txt": ("X [m] Y [m] Z [m] i\n1 2.5 3 9\n-4 5 600 8\n", {"intensity": [9, 8]}),
    "ene.csv": ("Easting,Northing,Elevation,R,G,B\n1,2.5,3,9,8,7\n-4,5,600,6,5,4\n",
                {"red": [9, 6], "green": [8, 5], "blue": [7, 4]}),
    "swapped.csv": ("Northing,Easting,Height\n2.5,1,3\n5,-4,600\n", {}),
    "paraview.csv": ('"Points:0","Points:1","Points:2","Normals:0"\n1,2.5,3,1\n-4,5,600,0\n', {"Normals:0": [1, 0]}),
    "cloudcompare.txt": ("//X Y Z R G B Scalar_field\n1 2.5 3 1 2 3 0.5\n-4 5 600 4 5 6 0.25\n",
                         {"red": [1, 4], "green": [2, 5], "blue": [3, 6], "Scalar_field": [0.5, 0.25]}),
    "count.txt": ("2\n1 2.5 3\n-4 5 600\n", {}),
    "hash.txt": ("# made by hand\n# x y z t\n1 2.5 3 7\n# in between\n-4 5 600 8\n", {"t": [7, 8]}),
    "percent.txt": ("% x y z\n1 2.5 3\n-4 5 600\n", {}),
    "semicolon-comment.txt": ("; exported 2020\n1 2.5 3\n-4 5 600\n", {}),
    "label.csv": ("x,y,z,label\n1,2.5,3,ground\n-4,5,600,tree\n", {}),
    "label-first.csv": ("name;x;y;z\nP1;1;2.5;3\nP2;-4;5;600\n", {}),
    "nameless-label.txt": ("P1 1 2.5 3\nP2 -4 5 600\n", {}),
    "missing.csv": ("x,y,z,q\n1,2.5,3,n/a\n-4,5,600,7\n", {"q": [np.nan, 7]}),
    "fortran.txt": ("0.1D+01 2.5d0 3.0D0\n-4.0D0 0.5D1 6.D+02\n", {}),
    "exponent.txt": ("1e0 2.5E0 3\n-4 5 6e2\n", {}),
    "crlf.txt": ("1 2.5 3\r\n-4 5 600\r\n", {}),
    "cr.txt": ("1 2.5 3\r-4 5 600\r", {}),
    "pts.pts": ("2\n1 2.5 3 -1024 9 8 7\n-4 5 600 2047 6 5 4\n",
                {"intensity": [-1024, 2047], "red": [9, 6], "green": [8, 5], "blue": [7, 4]}),
    "two-scans.pts": ("1\n1 2.5 3 7\n1\n-4 5 600 8\n", {"intensity": [7, 8]}),
    "rgb-normals.xyz": ("1 2.5 3 9 8 7 0 0 1\n-4 5 600 6 5 4 0.6 0 0.8\n",
                        {"red": [9, 6], "green": [8, 5], "blue": [7, 4], "nx": [0, 0.6], "ny": [0, 0], "nz": [1, 0.8]}),
    "colons.txt": ("1:2.5:3\n-4:5:600\n", {}),
    "colons-names.txt": ("X:Y:Z:i\n1:2.5:3:9\n-4:5:600:8\n", {"intensity": [9, 8]}),
    "rem.txt": ("REM exported by a survey\nrem x y z\n1 2.5 3\nREM in between\n-4 5 600\n", {}),
    "apostrophe.txt": ("' it's exported\n' x y z t\n1 2.5 3 7\n'in between\n-4 5 600 8\n", {"t": [7, 8]}),
    "apostrophe-quotes.csv": ("'x','y','z'\n'1','2.5','3'\n'-4','5','600'\n", {}),
    "dashes.txt": ("-- exported\n* by hand\n/* so */\n1 2.5 3\n-4 5 600\n", {}),
    "dashes-for-none.txt": ("x y z q\n1 2.5 3 --\n-4 5 600 *\n", {"q": [np.nan, np.nan]}),
    "asc.asc": ("1 2.5 3\n-4 5 600\n", {}),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("name", DIALECTS)
def test_every_dialect_holds_the_same_points(tmp_path: Path, name: str, encoding: str) -> None:
    text, attributes = DIALECTS[name]
    (tmp_path / name).write_bytes(text.encode(encoding))
    cloud = read_cloud(tmp_path / name)
    assert cloud.points.tolist() == [[1, 2.5, 3], [-4, 5, 600]]
    assert list(cloud.attributes) == list(attributes)
    for key, values in attributes.items():
        np.testing.assert_array_equal(cloud.attributes[key], values)
    assert cloud.left_out == (
        ("text column 'label'",) if name == "label.csv" else ("text column 'name'",) if name == "label-first.csv"
        else ("text column 1",) if name == "nameless-label.txt" else ()
    )  # fmt: skip


def test_points_numbered_in_their_first_column(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).random((30, 3)).round(3)
    text = "".join(f"{k + 7},{x},{y},{z}\n" for k, (x, y, z) in enumerate(rows))
    (tmp_path / "a.csv").write_text(text)
    cloud = read_cloud(tmp_path / "a.csv")
    np.testing.assert_array_equal(cloud.points, rows)
    assert cloud.left_out == ("column 1, the points' numbers",)


def test_empty_cells_of_coordinates_are_counted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z,i\n1,2,3,4\n1,,3,4\n1,2,NaN,4\n1,2,3,\n")
    cloud = read_cloud(tmp_path / "a.csv")
    assert (len(cloud), cloud.dropped) == (2, 2)
    assert describe(cloud)["missing"] == {"intensity": 1}


def test_a_long_file_is_read_as_its_parts(tmp_path: Path) -> None:
    """Over several blocks of lines, with an odd cell in a late one, and text where numbers were expected."""
    rows = np.random.default_rng(0).random((150_000, 4)).round(6)
    lines = [",".join(map(str, row)) for row in rows.tolist()]
    lines[140_000] = "0.5,0.5,0.5,n/a"
    (tmp_path / "a.csv").write_text("x,y,z,i\n" + "\n".join(lines) + "\n")
    cloud = read_cloud(tmp_path / "a.csv")
    rows[140_000] = [0.5, 0.5, 0.5, np.nan]
    np.testing.assert_array_equal(np.column_stack([cloud.points, cloud.attributes["intensity"]]), rows)
    lines[140_001] = "0.5,0.5,here,1"
    (tmp_path / "a.csv").write_text("x,y,z,i\n" + "\n".join(lines) + "\n")
    with pytest.raises(CloudFileError, match=r"line 140003: expected 4 numbers, found '0\.5,0\.5,here,1'"):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lon,lat,alt\n9.1,48.7,300\n", "longitude and latitude, and degrees are no lengths: project it"),
        ("Latitude;Longitude;Height\n48.7;9.1;300\n", "longitude and latitude"),
        ("48:12:05.5 9:10:44 300\n48:12:05.7 9:10:45 300\n", "degrees are no lengths"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 9\n", "is a pointer of Git LFS"),
        ("<!DOCTYPE html>\n<html>404</html>\n", "is a web page"),
        ("1/2/3\n", "expected numbers between blanks, tabs or one of , ; : |"),
        ("0 -1 0 9\n1 0 0 8\n0 0 1 7\n0 0 0 1\n", "holds a 4x4 transform and no points"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 5 0 1 0 0 0 0 1 0\n", "holds poses and no points"),
        ("a,b,c\n1,2,3\n", "line 1: expected numbers between blanks, tabs or one of , ; : |, or names"),
        ("1;2;3\n1,234.5;2;3\n", "line 2: '1,234.5' has marks between the thousands"),
        ("1.234,5;2;3\n1;2;3\n", "marks between the thousands"),
        ("x;y;z\n1'234.5;2;3\n", "marks between the thousands"),
        ('"1,234.5","2","3"\n', "marks between the thousands"),
        ('"1,5","2,5","3,5"\n', "commas both as decimals and between the columns"),
        ("3\n1 2 3\n4 5 6\n", "promises 3 points in its first line and holds 2, it is truncated"),
        ("1\n1 2 3\n4 5 6\n", "promises 1 points in its first line and holds 2"),
        ("[[1, 2, 3], [4, 5, 6]]\n", "line 1: has brackets around its points, as JSON has"),
        ('[{"x": 1, "y": 2, "z": 3}]\n', "has brackets around its points"),
        ("(1, 2, 3)\n(4, 5, 6)\n", "has brackets around its points"),
        ("1_000 2 3\n", "line 1: expected"),
        ("1 2\n", "line 1: has 2 columns"),
        ("x" * 3_000_000, "a line of more than 1048576 characters"),
    ],
)
def test_what_cannot_be_told_is_refused_with_its_cause(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(CloudFileError, match=re.escape(message)) as caught:
        read_cloud(tmp_path / "a.txt")
    assert str(caught.value).startswith(f"{tmp_path / 'a.txt'}: ")
    assert "\n" not in str(caught.value)


def test_gzip_is_read_and_does_not_unpack_without_end(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).random((1000, 3)).round(3)
    text = "\n".join(" ".join(map(str, row)) for row in rows.tolist())
    (tmp_path / "a.xyz.gz").write_bytes(gzip.compress(text.encode()))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.xyz.gz").points, rows)
    (tmp_path / "b.txt.gz").write_bytes(gzip.compress(b"1 2 3\n" * 4_000_000))
    with pytest.raises(CloudFileError, match="unpacks to more than 25 times its size"):
        read_cloud(tmp_path / "b.txt.gz")
    (tmp_path / "c.csv.gz").write_bytes(gzip.compress(text.encode())[:-300])
    with pytest.raises(CloudFileError, match="is it damaged"):
        read_cloud(tmp_path / "c.csv.gz")


def test_a_written_csv_starts_no_formula(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.csv", PointCloud(np.eye(3), {"=cmd()": np.arange(3), "+a": np.arange(3)}))
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "x,y,z,_cmd(),_a"


@pytest.mark.parametrize("named", [False, True])
def test_what_may_be_degrees_is_said(tmp_path: Path, named: bool) -> None:
    """A street of 100 m by Stuttgart in degrees and metres; the same in UTM; a column of half a metre and 6 m."""
    rng = np.random.default_rng(0)
    metres = rng.uniform(0, 1, (3000, 3)) * [100, 80, 12]
    degrees = metres / [73_500, 111_200, 1] + [9.1829, 48.7758, 240]
    column = metres / [200, 160, 2]
    head = "x,y,z" if named else ""
    for points, said in ((degrees, True), (degrees[:, [1, 0, 2]], True), (metres, False), (column, False)):
        np.savetxt(tmp_path / "a.csv", points, delimiter=",", fmt="%.8f", header=head, comments="")
        (note,) = read_cloud(tmp_path / "a.csv").notes or ("",)
        assert ("longitude and latitude" in note) == said


def test_align_says_what_may_be_degrees(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (300, 3)) * [1e-3, 1e-3, 12] + [9.1829, 48.7758, 240]
    np.savetxt(tmp_path / "a.csv", points, delimiter=",", fmt="%.8f")
    done = command.here("align", "a.csv", "a.csv", "--init", "identity", cwd=tmp_path)
    assert "warning: a.csv: its x and y may be" in done.stderr
