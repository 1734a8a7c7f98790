"""Point clouds, meshes, transforms and poses from and to files; the suffix says the format."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.addresses import address_of, local, shown
from fmr_cli.io.files import atomic_write, check_readable, reason, refuse_other_kind, shortened
from fmr_cli.io.mesh import Mesh
from fmr_cli.io.parts import ScanPart, is_bag_folder, part_name, topic_of
from fmr_cli.io.stream import CloudStream, Wanted, ahead, collect, stream_of
from fmr_cli.io.transforms import read_poses, read_transform, transform_text, write_poses, write_transform
from fmr_cli.vectors import unturned

# suffix -> (module that reads and writes it, format as PointCloud.format)
FORMATS = {
    ".ply": ("ply", "ply"),
    ".pcd": ("pcd", "pcd"),
    ".las": ("las", "las"),
    ".laz": ("las", "laz"),
    ".bin": ("bin_files", "kitti"),
    ".xyz": ("text", "xyz"),
    ".txt": ("text", "xyz"),
    ".asc": ("text", "xyz"),
    ".csv": ("text", "csv"),
    ".pts": ("text", "pts"),
    ".ptx": ("ptx", "ptx"),
    ".e57": ("e57", "e57"),
    ".bag": ("bags", "bag"),
    ".mcap": ("bags", "bag"),
    ".db3": ("bags", "bag"),
    ".npy": ("numpy_files", "npy"),
    ".npz": ("numpy_files", "npz"),
    ".off": ("mesh", "mesh"),
    ".obj": ("mesh", "mesh"),
    ".stl": ("mesh", "mesh"),
}
PARTED = ("e57", "ptx", "bags")  # modules whose files may hold several scans
PACKED = tuple(f"{suffix}.gz" for suffix, (module, _) in FORMATS.items() if module == "text")
SUFFIXES = (*FORMATS, *PACKED)
WRITABLE = tuple(suffix for suffix, (module, _) in FORMATS.items() if module not in ("mesh", "bags"))

__all__ = [
    "SUFFIXES",
    "WRITABLE",
    "CloudStream",
    "atomic_write",
    "open_cloud",
    "read_cloud",
    "read_poses",
    "read_transform",
    "scan_paths",
    "scans_of",
    "transform_text",
    "write_cloud",
    "write_poses",
    "write_transform",
]


def open_cloud(
    path: str | Path,
    *,
    mesh_points: int | None = None,
    seed: int = 0,
    attributes: bool = True,
    bin_columns: tuple[str, ...] | None = None,
    bounds: Sequence[float] | None = None,
    resolution: float | None = None,
    topic: str | None = None,
    enough: int | None = None,
) -> CloudStream:
    """A point cloud to be read a chunk at a time; nothing is read yet, but the file is there. As `read_cloud`.

    enough: a reader that can (COPC) may stop at so many points that are spread evenly.
    """
    module, kind, file, part = find_module(Path(path), SUFFIXES)
    check_there(file)
    box = checked_bounds(bounds)
    if resolution is not None and module.__name__ != "fmr_cli.io.las":
        raise CloudFileError(f"{path}: has no levels, --resolution needs a COPC (.copc.laz)")

    def chunks(attributes: bool = attributes) -> Iterator[PointCloud]:
        wanted = Wanted(attributes, part, bin_columns, box, resolution, enough, topic)
        points = dropped = 0
        with naming(file):
            here = local(file)
            check_kind(here, file)
        for chunk in ahead(guarded(module.read(here, wanted), file)):
            if isinstance(chunk, Mesh):
                with naming(file):
                    cloud, form = chunk.sample(mesh_points, seed), "mesh"
            else:
                cloud, form = chunk, kind
            finite = np.isfinite(cloud.points)
            bad = 0
            if not finite.all():  # point by point takes ten times as long
                whole = finite.all(axis=1)
                bad, cloud = int(len(whole) - whole.sum()), cloud.select(whole)
            if box is not None:
                inside = (cloud.points >= np.array(box[:3])) & (cloud.points <= np.array(box[3:]))
                cloud = cloud.select(np.flatnonzero(inside.all(axis=1)))
            cloud.path, cloud.format, cloud.dropped = Path(path), form, cloud.dropped + bad
            points, dropped = points + len(cloud), dropped + bad
            yield cloud
        if points == 0 and box is not None:
            raise CloudFileError(f"{shown(path)}: has no points within the bounds, compare them with `fmr info`")
        if points == 0:
            what = f"none of its {dropped} points has finite coordinates" if dropped else "holds no points"
            raise CloudFileError(f"{shown(path)}: {what}, check how it was written")

    return CloudStream(chunks, shown(path), bare=partial(chunks, attributes=False))


def read_cloud(
    path: str | Path,
    *,
    mesh_points: int | None = None,
    seed: int = 0,
    attributes: bool = True,
    at_most: int | None = None,
    bin_columns: tuple[str, ...] | None = None,
    bounds: Sequence[float] | None = None,
    resolution: float | None = None,
) -> PointCloud:
    """Reads a point cloud; points with NaN or infinite coordinates are dropped and counted in ``dropped``.

    path: FILE, or FILE#2 or FILE#name for one scan of a file that holds several; or an address (s3://bucket/a.laz) that
        fsspec knows, of which a copy is made.
    mesh_points: how many points to sample from the surface of a mesh; by default as many as it has vertices, at
        least 10,000 and at most 1,000,000. 0 gives the vertices themselves. ``seed`` makes the sample repeatable.
    attributes: False leaves everything but the coordinates in the file, which saves time and memory.
    at_most: of more than twice as many points, at least so many are kept, spread evenly; ``total`` says how many there
        are. The memory it takes then depends on this number only. Of a COPC only the coarse levels are read.
    bin_columns: what the numbers of a .bin are, where their values do not tell: names, or "name:type" of numpy.
    bounds: low x y z and high x y z, in the file's unit: only what lies within. Of a COPC nothing else is read.
    resolution: of a COPC, the spacing of points that is enough, in the file's unit.

    Raises CloudFileError, one line that names the file, for whatever is wrong with it.
    """
    stream = open_cloud(
        path, mesh_points=mesh_points, seed=seed, attributes=attributes, bin_columns=bin_columns, bounds=bounds,
        resolution=resolution, enough=at_most,
    )  # fmt: skip
    return collect(stream, at_most, seed)


def checked_bounds(bounds: Sequence[float] | None) -> tuple[float, ...] | None:
    """Six numbers, low before high. Raises CloudFileError."""
    if bounds is None:
        return None
    box = tuple(float(v) for v in bounds)
    if len(box) != 6 or not all(low <= high for low, high in zip(box[:3], box[3:], strict=True)):
        said = " ".join(f"{v:g}" for v in box)
        raise CloudFileError(f"--bounds {said}: give low x y z and then high x y z, each low below its high")
    return box


def scans_of(path: str | Path, topic: str | None = None) -> list[ScanPart]:
    """The scans of a file with their names and poses; of most formats one, in the file's own frame.

    Its name is then empty. Each but that is read by ``FILE#number``, numbers from 1, see ``scan_paths``. topic: of a
    bag. Raises CloudFileError.
    """
    path = Path(path)
    module, _, file, part = find_module(path, SUFFIXES)
    topic = topic or topic_of(part)
    if module.__name__.rsplit(".", 1)[1] not in PARTED or (part is not None and topic is None):
        return [ScanPart("", np.eye(4), 0)]
    check_scan(path)
    with naming(file):
        here = local(file)
        check_kind(here, file)
        return module.scans(here, topic) if topic is not None else module.scans(here)


def scan_paths(path: str | Path, topic: str | None = None) -> list[Path]:
    """What to read each scan of a file by: FILE#1, FILE#2, ... of a file that holds several, else the file itself."""
    parts = scans_of(path, topic)
    if len(parts) == 1 and not parts[0].name:
        return [Path(path)]
    _, _, file, part = find_module(Path(path), SUFFIXES)
    topic = topic or topic_of(part)
    return [file.with_name(f"{file.name}#{part_name(number, topic)}") for number in range(1, len(parts) + 1)]


def holds_scans(path: str | Path) -> bool:
    """Whether a path is a file of a kind that may hold several scans, and none of them: a bag, an E57, a PTX."""
    try:
        module, _, file, part = find_module(Path(path), SUFFIXES)
    except CloudFileError:
        return False
    whole = part is None or topic_of(part) is not None
    there = file.exists() or address_of(file) is not None
    return whole and there and module.__name__.rsplit(".", 1)[1] in PARTED


def check_scan(path: str | Path) -> None:
    """Raises CloudFileError where the file of a scan, FILE or FILE#part, is not there or of no kind that is read."""
    _, _, file, _ = find_module(Path(path), SUFFIXES)
    check_there(file)


def check_there(file: Path) -> None:
    """Raises CloudFileError where there is no such file. What is elsewhere is asked for when it is read."""
    if address_of(file) is None and not is_bag_folder(file):
        check_readable(file)


def check_kind(here: Path, file: Path) -> None:
    """Raises CloudFileError where the first bytes tell of another kind than the suffix. here: the file or its copy."""
    if here.is_file():
        module = FORMATS[suffix_of(file)][0]
        packed = (".gz",) if module == "text" else ()
        refuse_other_kind(here, (*(suffix for suffix, (other, _) in FORMATS.items() if other == module), *packed))


def write_cloud(path: str | Path, cloud: PointCloud | CloudStream) -> list[str]:
    """Writes a cloud in the format of the suffix and returns warnings: what the format cannot hold.

    A stream is read twice. A failure leaves whatever was at ``path`` before. Raises CloudFileError.
    """
    path = Path(path)
    module, _, _, _ = find_module(path, WRITABLE)
    stream = stream_of(cloud)
    if stream.survey.count == 0:
        raise CloudFileError(f"{path}: there are no points to write")
    head = stream.survey.head
    warnings = [f"{stream.name}: {note}" for note in head.notes]
    warnings += [f"{what} of {stream.name}: not kept" for what in head.left_out]
    warnings += unturned(head.attributes) if stream.turned else []
    with atomic_write(path) as temporary:
        try:
            return warnings + module.write(temporary, stream)
        except CloudFileError as error:
            if str(error).startswith(str(stream.name)):  # of reading it again
                raise
            raise CloudFileError(f"{path}: {error}") from error
        except (OSError, MemoryError):
            raise
        except Exception as error:
            raise CloudFileError(f"{path}: cannot be written as {path.suffix} ({reason(error)})") from error


def guarded(chunks: Iterator[PointCloud | Mesh], path: Path) -> Iterator[PointCloud | Mesh]:
    """The chunks of a reader, and whatever goes wrong as a CloudFileError of one line that names the file."""
    while True:
        with naming(path):
            chunk = next(chunks, None)
        if chunk is None:
            return
        yield chunk


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turns whatever goes wrong into a CloudFileError that names the file; numpy's warnings are silent meanwhile."""
    try:
        with np.errstate(all="ignore"):
            yield
    except CloudFileError as error:
        raise CloudFileError(f"{shown(path)}: {shortened(str(error))}") from error
    except MemoryError as error:
        raise CloudFileError(f"{shown(path)}: does not fit into this machine's memory, thin it out first") from error
    except Exception as error:
        what = f"cannot be read as {path.suffix} ({reason(error)}), is it damaged?"
        raise CloudFileError(f"{shown(path)}: {what}") from error


def parted(path: Path) -> tuple[Path, str]:
    """The file and the part that FILE#part means; a # may be in either's name, the longest name of a file counts."""
    places = [at for at, letter in enumerate(path.name) if letter == "#" and at]
    for at in reversed(places):
        if path.with_name(path.name[:at]).exists():
            break
    else:
        at = max(places, default=0)
    return (path.with_name(path.name[:at]) if at else path), path.name[at + 1 :]


def suffix_of(path: Path) -> str:
    """The suffix that says the format, in small letters: of what is packed, that of what is in it."""
    return (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()


def find_module(path: Path, suffixes: tuple[str, ...]) -> tuple[ModuleType, str, Path, str | None]:
    """The module for a path's suffix, which must be among ``suffixes``, and the format's name; the file and its part.

    FILE#2 is a part of FILE, unless there is a file of that very name.
    """
    part = None
    if "#" in path.name and suffixes is SUFFIXES and not path.exists():
        path, part = parted(path)
    if suffixes is SUFFIXES and is_bag_folder(path):
        return importlib.import_module("fmr_cli.io.bags"), "bag", path, part
    suffix = suffix_of(path)
    full = f"{suffix}.gz" if path.suffix.lower() == ".gz" else suffix
    if full not in suffixes:
        if path.is_dir():
            raise CloudFileError(f"{path}: is a folder, give a file in it")
        if suffixes is SUFFIXES and not path.exists() and not address_of(path):
            raise CloudFileError(f"{shown(path)}: no such file, check the name")
        what = f"the suffix {full!r} cannot be {'read' if suffixes is SUFFIXES else 'written'}"
        raise CloudFileError(f"{shown(path)}: {what if full else 'has no suffix'}, use one of {' '.join(suffixes)}")
    module, kind = FORMATS[suffix]
    if part is not None and module not in PARTED:
        raise CloudFileError(f"{shown(path)}: holds one scan, take the #{part} off its name")
    return importlib.import_module(f"fmr_cli.io.{module}"), kind, path, part
