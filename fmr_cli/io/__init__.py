"""Point clouds, meshes, transforms and poses from and to files; the suffix says the format."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import atomic_write, check_readable, reason
from fmr_cli.io.mesh import Mesh
from fmr_cli.io.transforms import read_poses, read_transform, transform_text, write_poses, write_transform

# suffix -> (module that reads and writes it, format as PointCloud.format)
FORMATS = {
    ".ply": ("ply", "ply"),
    ".pcd": ("pcd", "pcd"),
    ".las": ("las", "las"),
    ".laz": ("las", "laz"),
    ".bin": ("kitti", "kitti"),
    ".xyz": ("text", "xyz"),
    ".txt": ("text", "xyz"),
    ".csv": ("text", "csv"),
    ".npy": ("numpy_files", "npy"),
    ".npz": ("numpy_files", "npz"),
    ".off": ("mesh", "mesh"),
    ".obj": ("mesh", "mesh"),
    ".stl": ("mesh", "mesh"),
}
SUFFIXES = tuple(FORMATS)
WRITABLE = tuple(suffix for suffix, (module, _) in FORMATS.items() if module != "mesh")

__all__ = [
    "SUFFIXES",
    "WRITABLE",
    "atomic_write",
    "read_cloud",
    "read_poses",
    "read_transform",
    "transform_text",
    "write_cloud",
    "write_poses",
    "write_transform",
]


def read_cloud(
    path: str | Path, *, mesh_points: int | None = None, seed: int = 0, attributes: bool = True
) -> PointCloud:
    """Reads a point cloud; points with NaN or infinite coordinates are dropped and counted in ``dropped``.

    mesh_points: how many points to sample from the surface of a mesh; by default as many as it has vertices, at
        least 10,000 and at most 1,000,000. 0 gives the vertices themselves. ``seed`` makes the sample repeatable.
    attributes: False leaves everything but the coordinates in the file, which saves time and memory.

    Raises CloudFileError, one line that names the file, for whatever is wrong with it.
    """
    path = Path(path)
    module, kind = module_of(path, SUFFIXES)
    check_readable(path)
    try:
        with np.errstate(all="ignore"):
            cloud = module.read(path, attributes)
            if isinstance(cloud, Mesh):
                cloud, kind = cloud.sample(mesh_points, seed), "mesh"
            finite = np.isfinite(cloud.points).all(axis=1)
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from error
    except MemoryError as error:
        raise CloudFileError(f"{path}: does not fit into this machine's memory, thin it out first") from error
    except Exception as error:
        raise CloudFileError(f"{path}: cannot be read as {path.suffix} ({reason(error)}), is it damaged?") from error
    if not finite.any():
        what = "holds no points" if len(cloud) == 0 else f"none of its {len(cloud)} points has finite coordinates"
        raise CloudFileError(f"{path}: {what}, check how it was written")
    dropped = int(len(finite) - finite.sum())
    if dropped:
        cloud = cloud.select(finite)
    cloud.path, cloud.format, cloud.dropped = path, kind, cloud.dropped + dropped
    return cloud


def write_cloud(path: str | Path, cloud: PointCloud) -> list[str]:
    """Writes a cloud in the format of the suffix and returns warnings: what the format cannot hold.

    A failure leaves whatever was at ``path`` before. Raises CloudFileError.
    """
    path = Path(path)
    module, _ = module_of(path, WRITABLE)
    if len(cloud) == 0:
        raise CloudFileError(f"{path}: there are no points to write")
    with atomic_write(path) as temporary:
        try:
            return module.write(temporary, cloud)
        except CloudFileError as error:
            raise CloudFileError(f"{path}: {error}") from error
        except (OSError, MemoryError):
            raise
        except Exception as error:
            raise CloudFileError(f"{path}: cannot be written as {path.suffix} ({reason(error)})") from error


def module_of(path: Path, suffixes: tuple[str, ...]) -> tuple[ModuleType, str]:
    """The module for the path's suffix, which must be among ``suffixes``, and the format's name."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        what = f"the suffix {suffix!r} cannot be {'read' if suffixes is SUFFIXES else 'written'}"
        raise CloudFileError(f"{path}: {what if suffix else 'has no suffix'}, use one of {' '.join(suffixes)}")
    name, kind = FORMATS[suffix]
    return importlib.import_module(f"fmr_cli.io.{name}"), kind
