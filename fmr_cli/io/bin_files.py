""".bin: numbers and nothing else.

3 to 10 float32 a point (KITTI 4, nuScenes 5), some of them uint32; float64; records with a 2-byte ring as drivers pack
them; NCLT's 8 bytes a point. How many, and what they are, stands nowhere: it is told by the values, unless
`Wanted.bin_columns` names them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import are_colors, bare_names, lost_context, native
from fmr_cli.io.stream import CHUNK, COLORS, CloudStream, Wanted

WIDTHS = range(3, 11)  # numbers a point
PERIOD = 2520  # the least common multiple of the widths: samples that start at its multiples start with a point
SAMPLES = 24  # of PERIOD numbers each, spread over the file
BINS = 24
# Of the information of the best width, in what column a number stands: a narrower one that comes as near is right,
# since twice the width tells the columns apart as well. Columns of one kind tell less than UNCLEAR nats.
NEARLY, UNCLEAR = 0.85, 0.02
FEW = 600  # numbers, of which no distribution can be told: such a file is taken for KITTI's where it may be
PLAUSIBLE = (1e-6, 1e7)  # sizes of a number that is a coordinate or an attribute; what is none has any exponent
RINGS = 256  # lasers of a scanner
# As drivers for ROS pack their points; numpy's types
PACKED = (
    ("x", "y", "z", "intensity", "ring:u2"),
    ("x", "y", "z", "intensity", "ring:u2", "time"),
    ("x", "y", "z", "intensity", "ring:u2", "time:f8"),
)
NCLT = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("ring", "u1")])  # 5 mm steps from -100 m
NCLT_STEP, NCLT_ORIGIN, NCLT_RINGS = 0.005, -100.0, 32
HELP = "say what they are, such as --bin-columns x,y,z,intensity or, with numpy's types, x:f8,y:f8,z:f8,ring:u2"


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    size = path.stat().st_size
    if wanted.bin_columns is None:
        columns = find_columns(path, size)
        if columns is None:
            yield from read_nclt(path, wanted.attributes)
            return
    else:
        columns = wanted.bin_columns
    dtype = record_of(columns)
    if size % dtype.itemsize:
        raise CloudFileError(
            f"holds {size} bytes, no multiple of the {dtype.itemsize} that a point takes ({' '.join(columns)}): {HELP}"
        )
    layout = None
    if wanted.bin_columns is None and columns != ("x", "y", "z", "intensity"):
        layout = f"{dtype.itemsize} bytes a point, by their values {' '.join(columns)}"
    with path.open("rb") as file:
        for _ in range(0, size // dtype.itemsize, CHUNK):
            rows = np.fromfile(file, dtype, CHUNK)
            points = np.stack([rows[axis] for axis in "xyz"], 1)
            names = [name for name in dtype.names or () if name not in "xyz"]
            kept = {name: native(rows[name]) for name in names} if wanted.attributes else {}
            yield PointCloud(points, kept, sensor_origin=np.zeros(3), layout=layout)


def record_of(columns: Iterable[str]) -> np.dtype:
    """The record of columns "name" (float32) or "name:type" (numpy's name of the type, little endian)."""
    given = [column.partition(":") for column in columns]
    names = [name for name, _, _ in given]
    said = f"--bin-columns {','.join(columns)}:"
    if not {*"xyz"} <= {*names} or len({*names}) < len(names):
        raise CloudFileError(f"{said} there must be one x, one y and one z, and each other name once")
    try:
        fields = [(name, np.dtype(kind or "f4").newbyteorder("<")) for name, _, kind in given]
        return np.dtype(fields)
    except TypeError as error:
        raise CloudFileError(f"{said} {error}; types are such as f4, f8, u1, u2, i4") from None


def find_columns(path: Path, size: int) -> tuple[str, ...] | None:
    """What a point holds, told by the values; None for NCLT's records.

    Raises CloudFileError where nothing fits, or two layouts do.
    """
    sample = sample_of(path, size, "<f4")
    holes = np.isnan(sample).sum() > 0.1 * len(sample)  # colours with an alpha are NaN as float32
    wholes = whole_numbers_among(sample, size) if holes or not plausible(sample) else []
    if plausible(sample) and not wholes:
        return columns_of(sample, size, "")
    if size % NCLT.itemsize == 0 and is_nclt(path):
        return None
    found: list[tuple[str, ...]] = [columns for columns in PACKED if is_packed(path, size, columns)]
    packed = [record_of(columns).itemsize for columns in found]
    # Two records of another kind may look like one of many numbers
    found += [columns for columns in wholes if all(record_of(columns).itemsize % width for width in packed)]
    if not found and size % 8 == 0 and plausible(doubles := sample_of(path, size, "<f8")):
        return columns_of(doubles, size, ":f8")
    if len(found) > 1:
        choice = " or ".join(" ".join(columns) for columns in found)
        raise CloudFileError(f"may hold {choice}, its values do not tell which: {HELP}")
    if found:
        return found[0]
    with path.open("rb") as file:
        head = file.read(1000)
    if all(c in b"\t\r\n" or 32 <= c < 127 for c in head):
        raise CloudFileError("is text: give it the suffix of what it is, such as .xyz")
    raise CloudFileError(f"holds no float32 coordinates, nor another layout that is known: {HELP}")


def whole_numbers_among(sample: np.ndarray, size: int) -> list[tuple[str, ...]]:
    """Layouts of 4-byte numbers some of which are uint32: as float32 those would be tiny, huge or no number."""
    found: list[tuple[str, ...]] = []
    for width in WIDTHS:
        if size % (4 * width) or any(width % len(columns) == 0 for columns in found):
            continue
        rows = sample[: len(sample) // width * width].reshape(-1, width)
        whole = np.array([(~is_plausible(column)).mean() > 0.8 for column in rows.T])
        floats = all(plausible(column) for column in rows.T[~whole])
        if whole.any() and not whole[:3].any() and floats and (np.ptp(rows[:, :3], axis=0) > 0).all():
            values = np.where(whole, np.ascontiguousarray(rows).view("<u4"), rows.astype(np.float64))
            names = name_columns(values[:, 3:], wide=bool(whole[3]))
            kinds = [":u4" if w else "" for w in whole[3:]]
            found.append(("x", "y", "z", *(name + kind for name, kind in zip(names, kinds, strict=True))))
    return found


def is_packed(path: Path, size: int, columns: tuple[str, ...]) -> bool:
    dtype = record_of(columns)
    if size % dtype.itemsize:
        return False
    rows = np.fromfile(path, dtype, 10_000)
    moves = all(np.ptp(rows[axis]) > 0 for axis in "xyz")
    floats = all(plausible(rows[name]) for name in dtype.names or () if dtype[name].kind == "f")
    return bool(floats and moves and rows["ring"].max() < RINGS)


def sample_of(path: Path, size: int, kind: str) -> np.ndarray:
    """Numbers from all over the file, each run of them beginning with a point whatever the width: (n,)."""
    width = np.dtype(kind).itemsize
    numbers = np.memmap(path, kind, "r", shape=size // width) if size >= width else np.empty(0, kind)
    runs = max(len(numbers) // PERIOD, 1)
    starts = np.unique(np.linspace(0, runs - 1, min(SAMPLES, runs), dtype=int)) * PERIOD
    return np.concatenate([numbers[start : start + PERIOD] for start in starts])


def is_plausible(values: np.ndarray) -> np.ndarray:
    """Which numbers may be those of a scan: neither huge nor tiny."""
    magnitude = np.abs(values)
    return (magnitude == 0) | ((magnitude > PLAUSIBLE[0]) & (magnitude < PLAUSIBLE[1]))


def plausible(sample: np.ndarray) -> bool:
    """Whether the numbers are those of a scan, but for a few; those that are not finite, of no return, do not count."""
    finite = sample[np.isfinite(sample)]
    return bool(is_plausible(finite).mean() > 0.98) if len(finite) else True


def columns_of(sample: np.ndarray, size: int, kind: str) -> tuple[str, ...]:
    """The columns of numbers of one type, told by the values.

    Raises CloudFileError where nothing fits, or two widths do.
    """
    fitting = [width for width in WIDTHS if size % (sample.itemsize * width) == 0]
    if not fitting:
        raise CloudFileError(f"holds {size} bytes, which is no number of points of 3 to 10 float32: copy it again")
    width = find_width(sample, fitting)
    rows = sample[: len(sample) // width * width].reshape(-1, width)
    names = ["x", "y", "z", *name_columns(rows[np.isfinite(rows).all(1), 3:])]
    return tuple(name + kind for name in names)


def find_width(sample: np.ndarray, fitting: list[int]) -> int:
    """How many numbers a point has: as many as tell best what value stands where."""
    if len(fitting) == 1 or (4 in fitting and np.isfinite(sample).sum() < FEW):
        return 4 if 4 in fitting else fitting[0]
    quantile = quantiles(sample)
    told = {width: column_information(quantile, width) for width in fitting}
    best = max(told.values())
    near = [width for width in fitting if told[width] >= NEARLY * best]
    rivals = [w for w in near if w % near[0]]
    if best < UNCLEAR or rivals:
        choice = ", ".join(f"{w} float32" for w in (fitting if best < UNCLEAR else [near[0], *rivals]))
        raise CloudFileError(f"may hold {choice} a point, its values do not tell which: {HELP}")
    return near[0]


def quantiles(sample: np.ndarray) -> np.ndarray:
    """Which of BINS quantiles each number is in, (n,) int from 0; BINS where it is not finite."""
    finite = np.isfinite(sample)
    edges = np.unique(np.quantile(sample[finite], np.linspace(0, 1, BINS + 1)[1:-1]))
    return np.where(finite, np.searchsorted(edges, sample, side="right"), BINS)


def column_information(quantile: np.ndarray, width: int) -> float:
    """The mutual information, nats, of a number's value and its place in the point, if a point has ``width``.

    Where the width is wrong, every column is a mixture of several and looks like the others. Values are told apart
    by ``quantiles`` (n,), and what a finite sample gives by chance is taken off (Miller and Madow).
    """
    rows = quantile[: len(quantile) // width * width].reshape(-1, width)
    counts = np.stack([np.bincount(column, minlength=BINS + 1) for column in rows.T]).astype(float)
    share = counts / counts.sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = share * np.log(share / (share.sum(0) * share.sum(1, keepdims=True)))
    used = (counts.sum(0) > 0).sum()
    return float(np.nansum(terms) - (width - 1) * (used - 1) / (2 * rows.size))


def name_columns(extra: np.ndarray, wide: bool = False) -> list[str]:
    """What the numbers after x y z are: intensity first, small integers a ring, what rises a time; colours, normals.

    wide: whether the first is an uint32.
    """
    count = extra.shape[1]
    names = bare_names(extra) if count >= 3 and not wide else []
    if names and not names[0].startswith("column_"):
        return names
    if count > 3 and are_colors(extra[:, :3]) and (extra[:, :3].max(0) > 127).all():
        return [*COLORS, *name_singly(extra[:, 3:], 7)]
    if count == 3 and ((extra >= 0) & (extra <= 1)).all() and not any(map(rises, extra.T)):
        return [*COLORS]
    return name_singly(extra, 4, wide)


def name_singly(extra: np.ndarray, first: int, wide: bool = False) -> list[str]:
    """Names of single columns, the first of which is the file's ``first``, from 1, and an uint32 if ``wide``."""
    names: list[str] = []
    for k, column in enumerate(extra.T):
        whole = bool(len(column) and (column == np.rint(column)).all() and column.min() >= 0)
        if k == 0 and not wide:
            names.append("intensity")
        elif whole and column.max() < RINGS and "ring" not in names:
            names.append("ring")
        elif rises(column) and "time" not in names:
            names.append("time")
        elif k == 0 and packs_color(column):
            names.append("color")
        else:
            names.append(f"column_{first + k}" if k else "intensity")
    return names


def packs_color(column: np.ndarray) -> bool:
    """Whether whole numbers are three bytes of a colour and an opacity; in which order, no value says."""
    opacity, rest = column.astype(np.uint32) >> 24, column.astype(np.uint32) & 0xFFFFFF
    return bool(len(column) and np.ptp(opacity) == 0 and opacity[0] in (0, 255) and (rest > 0xFFFF).mean() > 0.2)


def rises(column: np.ndarray) -> bool:
    """Whether values are those of a clock: nearly none is below the one before."""
    return bool(len(column) > 1 and np.ptp(column) > 0 and (np.diff(column.astype(np.float64)) >= 0).mean() > 0.9)


def is_nclt(path: Path) -> bool:
    head = np.fromfile(path, NCLT, 10_000)
    return bool(len(head) and head["ring"].max() < NCLT_RINGS and (np.ptp(head["xyz"].astype(int), axis=0) > 0).all())


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
