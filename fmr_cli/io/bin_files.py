""".bin: float32 numbers and nothing else, 3 to 8 of them a point (KITTI 4, nuScenes 5), or NCLT's 8 bytes a point.

How many, and what they are, stands nowhere: it is told by the values, unless `Wanted.bin_columns` names them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import bare_names, lost_context
from fmr_cli.io.stream import CHUNK, CloudStream, Wanted

WIDTHS = range(3, 9)  # float32 a point
PERIOD = 840  # the least common multiple of the widths: samples that start at its multiples start with a point
SAMPLES = 24  # of PERIOD numbers each, spread over the file
BINS = 24
# Of the information of the best width, in what column a number stands: a narrower one that comes as near is right,
# since twice the width tells the columns apart as well. Columns of one kind tell less than UNCLEAR nats.
NEARLY, UNCLEAR = 0.85, 0.02
FEW = 600  # numbers, of which no distribution can be told: such a file is taken for KITTI's where it may be
PLAUSIBLE = (1e-6, 1e7)  # sizes of a float32 that is a coordinate or an attribute; what is none has any exponent
NCLT = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("ring", "u1")])  # 5 mm steps from -100 m
NCLT_STEP, NCLT_ORIGIN, NCLT_RINGS = 0.005, -100.0, 32
HELP = "say what they are, such as --bin-columns x,y,z,intensity"


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    size = path.stat().st_size
    sample = sample_of(path, size)
    if wanted.bin_columns is None and not plausible(sample) and size % NCLT.itemsize == 0 and is_nclt(path):
        yield from read_nclt(path, wanted.attributes)
        return
    names = list(wanted.bin_columns) if wanted.bin_columns else find_columns(sample, size)
    if size % (4 * len(names)):
        raise CloudFileError(f"holds {size} bytes, no multiple of {len(names)} float32 ({' '.join(names)}): {HELP}")
    layout = None
    if wanted.bin_columns is None and names != ["x", "y", "z", "intensity"]:
        layout = f"{len(names)} float32 a point, by their values {' '.join(names)}"
    with path.open("rb") as file:
        for _ in range(0, size // (4 * len(names)), CHUNK):
            rows = np.fromfile(file, "<f4", CHUNK * len(names)).reshape(-1, len(names))
            points = rows[:, [names.index(axis) for axis in "xyz"]]
            kept = {n: rows[:, k].copy() for k, n in enumerate(names) if n not in "xyz"} if wanted.attributes else {}
            yield PointCloud(points, kept, sensor_origin=np.zeros(3), layout=layout)


def sample_of(path: Path, size: int) -> np.ndarray:
    """Numbers from all over the file, each run of them beginning with a point whatever the width: (n, PERIOD)."""
    numbers = np.memmap(path, "<f4", "r", shape=size // 4) if size >= 4 else np.empty(0, "<f4")
    runs = max(len(numbers) // PERIOD, 1)
    starts = np.unique(np.linspace(0, runs - 1, min(SAMPLES, runs), dtype=int)) * PERIOD
    return np.concatenate([numbers[start : start + PERIOD] for start in starts])


def plausible(sample: np.ndarray) -> bool:
    """Whether the numbers are float32 of a scan: neither huge nor tiny, but for a few."""
    magnitude = np.abs(sample[np.isfinite(sample)])
    inside = (magnitude == 0) | ((magnitude > PLAUSIBLE[0]) & (magnitude < PLAUSIBLE[1]))
    return bool(inside.mean() > 0.98) if len(inside) else True


def find_columns(sample: np.ndarray, size: int) -> list[str]:
    """The columns' names, told by the values. Raises CloudFileError where nothing fits, or two widths do."""
    fitting = [width for width in WIDTHS if size % (4 * width) == 0]
    if not fitting:
        raise CloudFileError(f"holds {size} bytes, which is no number of points of 3 to 8 float32: copy it again")
    if not plausible(sample):
        raise CloudFileError("holds no float32 coordinates, nor another layout that is known: write it as .ply or .npy")
    width = find_width(sample, fitting)
    rows = sample[: len(sample) // width * width].reshape(-1, width)
    return ["x", "y", "z", *name_columns(rows[np.isfinite(rows).all(1), 3:])]


def find_width(sample: np.ndarray, fitting: list[int]) -> int:
    """How many numbers a point has: as many as tell best what value stands where."""
    if len(fitting) == 1 or (4 in fitting and np.isfinite(sample).sum() < FEW):
        return 4 if 4 in fitting else fitting[0]
    told = {width: column_information(sample, width) for width in fitting}
    best = max(told.values())
    near = [width for width in fitting if told[width] >= NEARLY * best]
    rivals = [w for w in near if w % near[0]]
    if best < UNCLEAR or rivals:
        choice = ", ".join(f"{w} float32" for w in (fitting if best < UNCLEAR else [near[0], *rivals]))
        raise CloudFileError(f"may hold {choice} a point, its values do not tell which: {HELP}")
    return near[0]


def column_information(sample: np.ndarray, width: int) -> float:
    """The mutual information, nats, of a number's value and its place in the point, if a point has ``width``.

    Where the width is wrong, every column is a mixture of several and looks like the others. Values are told apart
    by BINS quantiles, and what a finite sample gives by chance is taken off (Miller and Madow).
    """
    rows = sample[: len(sample) // width * width].reshape(-1, width)
    edges = np.unique(np.quantile(rows[np.isfinite(rows)], np.linspace(0, 1, BINS + 1)[1:-1]))
    place = np.where(np.isfinite(rows), np.searchsorted(edges, rows, side="right"), len(edges) + 1)
    counts = np.stack([np.bincount(column, minlength=len(edges) + 2) for column in place.T]).astype(float)
    share = counts / counts.sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = share * np.log(share / (share.sum(0) * share.sum(1, keepdims=True)))
    used = (counts.sum(0) > 0).sum()
    return float(np.nansum(terms) - (width - 1) * (used - 1) / (2 * rows.size))


def name_columns(extra: np.ndarray) -> list[str]:
    """What the numbers after x y z are: an intensity first, small integers a ring, else times; colours, normals."""
    names = bare_names(extra) if extra.shape[1] >= 3 else []
    if names and not names[0].startswith("column_"):
        return names
    names = []
    for k, column in enumerate(extra.T):
        whole = bool(len(column) and (column == np.rint(column)).all() and column.min() >= 0)
        if k == 0:
            names.append("intensity")
        elif whole and column.max() < 256 and "ring" not in names:
            names.append("ring")
        elif k == extra.shape[1] - 1 and not whole and "time" not in names:
            names.append("time")
        else:
            names.append(f"column_{4 + k}")
    return names


def is_nclt(path: Path) -> bool:
    head = np.fromfile(path, NCLT, 10_000)
    return bool(head["ring"].max() < NCLT_RINGS and (np.ptp(head["xyz"].astype(int), axis=0) > 0).all())


def read_nclt(path: Path, attributes: bool) -> Iterator[PointCloud]:
    with path.open("rb") as file:
        while len(rows := np.fromfile(file, NCLT, CHUNK)):
            points = rows["xyz"] * NCLT_STEP + NCLT_ORIGIN
            kept = {name: rows[name].copy() for name in ("intensity", "ring")} if attributes else {}
            layout = "8 bytes a point, as NCLT has them: x y z in 5 mm, intensity ring"
            yield PointCloud(points, kept, sensor_origin=np.zeros(3), layout=layout)


def write(path: Path, stream: CloudStream) -> list[str]:
    """As KITTI has it: x, y, z, intensity."""
    survey = stream.survey
    if not np.isfinite(survey.rest):
        raise CloudFileError("coordinates beyond 3e38 do not fit into float32, write .ply or .las")
    warnings = []
    if survey.rest > 0:
        warnings.append(f".bin holds float32 only: coordinates are rounded by up to {survey.rest:.2g}")
    intensity = survey.columns.get("intensity")
    given = intensity is not None and not intensity.shape and intensity.dtype.kind in "biuf"
    if not given:
        warnings.append(".bin has an intensity for each point and the cloud has none: zeros are written")
    lost = [name for name in survey.columns if name != "intensity" or not given]
    if lost:
        warnings.append(f".bin cannot hold the attributes {', '.join(lost)}: left out")
    rounded = False
    with path.open("wb") as file:
        for cloud in stream:
            rows = np.zeros((len(cloud), 4), "<f4")
            rows[:, :3] = cloud.points
            if given:
                values = cloud.attributes["intensity"]
                rows[:, 3] = values
                rounded |= not np.array_equal(rows[:, 3], values, equal_nan=values.dtype.kind == "f")
            file.write(rows.tobytes())
    if rounded:
        warnings.append(".bin holds float32 only: intensity is rounded")
    return warnings + lost_context(survey.head, ".bin")
