"""LAS and LAZ 1.0 to 1.4, every point format, extra bytes; the header (VLRs, CRS, scales) goes along to the output."""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.point.dims import WAVEFORM_FIELDS_NAMES
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io import copc
from fmr_cli.io.fields import lost_context, unique
from fmr_cli.io.stream import CHUNK, COLORS, CloudStream, Column, Survey, Wanted

logging.getLogger("laspy").addHandler(logging.NullHandler())  # its errors come as exceptions; no second line on stderr

WITH_COLORS = {0: 2, 1: 3, 4: 5, 6: 7, 9: 10}  # the point format that adds red, green and blue
LARGEST = 2**31 - 1
SMALL, LAZ_LIMIT = 1 << 26, 5000  # bytes nobody minds to allocate; and LAZ does not shrink scans more than this
PROJECTED, GEOGRAPHIC, USER_DEFINED = 3072, 2048, 32767  # GeoTIFF keys, and their value for "not in EPSG"
# Compressed layers of LAZ 1.4 by the item's type: point, RGB, RGB + NIR, wave packet; of extra bytes one each (14)
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
POINTWISE, CHUNKED, LAYERED = 1, 2, 3  # LASzip's compressors; the first, of before 2011, is unknown to lazrs
# Marks the extra bytes in which `write` puts an intensity that the 16 bits of LAS's own do not hold
INTENSITY = ("Intensity", "not in 16 bits")
XYZ = laspy.DecompressionSelection.xy_returns_channel().decompress_z()


class ClippedFile(io.BufferedReader):
    """A file whose read never allocates more than is left in it, whatever length a damaged header asks for."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(self.size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    check_header(path)
    selection = laspy.DecompressionSelection.all() if wanted.attributes else XYZ
    try:
        with ClippedFile(path) as file, laspy.open(file, decompression_selection=selection, closefd=False) as reader:
            header = reader.header
            packed = header.are_points_compressed and header.point_count
            chunks_there = check_layers(file, header) if packed else set()
            if header.point_count == 0:
                raise CloudFileError("holds no points (its header says 0), check how it was written")
            dimensions = header.point_format.dimensions
            # Extra bytes may be called as another dimension is; numpy and laspy tell them apart by name only.
            for k, name in enumerate(unique([d.name for d in dimensions])):
                dimensions[k] = dimensions[k]._replace(name=name)
            names = [d.name for d in dimensions if d.name not in "XYZ"] if wanted.attributes else []
            left_out = ["waveform packets"] if header.global_encoding.waveform_data_packets_internal else []
            if names and garbled_waveforms(path, header):
                names = [name for name in names if name not in WAVEFORM_FIELDS_NAMES]
                left_out.append("waveform fields (lazrs garbles them where there are several scanner channels)")
            own_intensity = any((d.name, d.description) == INTENSITY for d in header.point_format.extra_dimensions)
            crs = crs_of(header)
            done = 0
            chunks, expected = reader.chunk_iterator(CHUNK), header.point_count
            info = copc.info_of(header)
            if info is not None and (wanted.bounds or wanted.resolution or wanted.at_most):
                cells = copc.wanted_cells(copc.cells_of(file, info, file.size, chunks_there), info, wanted)
                chunks, expected = copc.records(file, header, cells, selection), sum(c.count for c in cells)
            elif wanted.resolution:
                raise CloudFileError("has no levels, --resolution needs a COPC: make one with `untwine` or `pdal`")
            total = header.point_count if wanted.at_most and expected < header.point_count else None
            for chunk in chunks:
                points = np.empty((len(chunk), 3))
                for i, axis in enumerate("XYZ"):
                    points[:, i] = chunk[axis] * header.scales[i] + header.offsets[i]
                kept = {name: np.array(chunk[name]) for name in names}
                if own_intensity and names:
                    kept["intensity"] = kept.pop("Intensity")
                done += len(chunk)
                yield PointCloud(points, kept, crs=crs, las_header=header, left_out=tuple(left_out), total=total)
            if done != expected:
                raise CloudFileError(f"promises {expected} points and holds {done}: copy it again")
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # what lazrs raises on some damaged files is no Exception
            raise
        raise CloudFileError("has damaged compressed data: copy it again") from error


def check_header(path: Path) -> None:
    """Whether what the header promises can be in a file of this size, before anything is allocated for it."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
        if len(head) < 227 or head[:4] != b"LASF":
            raise CloudFileError("is not a LAS file, or truncated within its header")
        minor = head[25]
        header_size, start, vlrs, point_format, point_size, count = struct.unpack_from("<HIIBHI", head, 94)
        first_evlr, evlrs = 0, 0
        if minor >= 4:
            if len(head) < 375:
                raise CloudFileError("is truncated within its header: copy it again")
            first_evlr, evlrs, count = struct.unpack_from("<QIQ", head, 235)
        if head[24] != 1 or start > size or header_size + 54 * vlrs > start or first_evlr + 60 * evlrs > size:
            raise CloudFileError("has a damaged header, or is truncated: copy it again")
        if point_format < 128:
            if start + count * point_size > size:
                holds = (size - start) // max(point_size, 1)
                raise CloudFileError(f"promises {count} points and holds {holds}, it is truncated: copy it again")
        elif count:
            check_compressor(file, header_size, vlrs)
            check_chunks(file, size, start, count, point_size)


def check_compressor(file: io.BufferedReader, header_size: int, vlrs: int) -> None:
    """LAZ: raises CloudFileError where the points were compressed by another than LASzip's chunked compressors."""
    file.seek(header_size)
    for _ in range(vlrs):
        head = file.read(54)
        if len(head) < 54:
            return
        length = int.from_bytes(head[20:22], "little")
        body = file.read(length)
        if head[2:16] == b"laszip encoded" and len(body) >= 2:
            compressor = int.from_bytes(body[:2], "little")
            if compressor == POINTWISE:
                raise CloudFileError(
                    "was compressed by a LASzip of before 2011 (point by point), which is not supported: "
                    "rewrite it with `laszip` or `las2las`, in or out of compression"
                )
            if compressor not in (CHUNKED, LAYERED):
                raise CloudFileError(f"is compressed in a way that is not known (LASzip's number {compressor})")


def check_chunks(file: io.BufferedReader, size: int, start: int, count: int, point_size: int) -> None:
    """LAZ: the table of chunks must be there, and the chunks large enough for all points."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # written to a pipe: the place is in the last bytes of the file
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    file.seek(max(min(table, size), 0))
    words = file.read(8)
    if not start + 8 <= table <= size - 8 or len(words) < 8:
        raise CloudFileError("lacks the table of its compressed chunks, it is truncated: copy it again")
    chunks = int.from_bytes(words[4:], "little")
    if chunks * point_size > table - start or chunks > count or chunks == 0:
        raise CloudFileError("has a damaged table of compressed chunks: copy it again")


def check_layers(file: ClippedFile, header: laspy.LasHeader) -> set[tuple[int, int, int]]:
    """LAZ: chunks, and in 1.4 their layers, must be of a possible size, since lazrs allocates what they promise.

    Returns where each chunk is, its bytes and its points; leaves the file at the start of the points.
    """
    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise CloudFileError("is compressed and lacks the record that says how, it is damaged: copy it again")
    record = records[0].record_data
    chunk_points, count = struct.unpack_from("<I", record, 12)[0], struct.unpack_from("<H", record, 32)[0]
    items = [struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(count)]
    if chunk_points == 0 or sum(size for _, size in items) != header.point_format.size:
        raise CloudFileError("does not say rightly how its points are compressed, it is damaged: copy it again")
    layers = sum(LAYERS.get(kind, size) for kind, size in items if kind >= min(LAYERS))
    file.seek(header.offset_to_point_data)
    table = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    if sum(count for count, _ in table) < header.point_count:
        raise CloudFileError(f"promises {header.point_count} points and holds fewer, it is truncated: copy it again")
    if sum(size for _, size in table) > file.size:
        raise CloudFileError("has a damaged table of compressed chunks: copy it again")
    if max(count for count, _ in table) * header.point_format.size > max(SMALL, LAZ_LIMIT * file.size):
        raise CloudFileError("promises more points than its compressed data can hold, it is damaged: copy it again")
    start = header.offset_to_point_data + 8
    raw = sum(size for _, size in items) + 4  # a chunk begins with its first point as it is and a count
    found = set()
    for count, size in table:
        found.add((start, size, count))
        if layers and count:
            file.seek(start)
            head = file.read(raw + 4 * layers)
            if len(head) < raw + 4 * layers or len(head) + sum(struct.unpack_from(f"<{layers}I", head, raw)) > size:
                raise CloudFileError("has a damaged compressed chunk: copy it again")
        start += size
    file.seek(header.offset_to_point_data)
    return found


def garbled_waveforms(path: Path, header: laspy.LasHeader) -> bool:
    """lazrs (0.8) mixes up the wave packet fields of point formats 9 and 10 between the scanner's channels."""
    if header.point_format.id not in (9, 10) or not header.are_points_compressed:
        return False
    with laspy.open(path, decompression_selection=XYZ) as reader:
        channels = {int(c) for chunk in reader.chunk_iterator(CHUNK) for c in np.unique(chunk["scanner_channel"])}
    return len(channels) > 1


def crs_of(header: laspy.LasHeader) -> str | None:
    """The WKT of the header, or "EPSG:n" from its GeoTIFF keys, or None."""
    records = [*header.vlrs, *(header.evlrs or [])]
    for record in records:
        if isinstance(record, WktCoordinateSystemVlr) and record.string.strip("\0 \n"):
            return record.string.strip("\0 \n")
    for record in records:
        if isinstance(record, GeoKeyDirectoryVlr):
            keys = {key.id: key.value_offset for key in record.geo_keys}
            for key in (PROJECTED, GEOGRAPHIC):
                if 0 < keys.get(key, 0) < USER_DEFINED:
                    return f"EPSG:{keys[key]}"
    return None


@dataclass
class Placed:
    """Where an attribute goes: a dimension of the file, after a factor."""

    name: str
    of: str
    dtype: np.dtype
    part: int | None = None  # of an (N, k) attribute, one column
    factor: int = 1

    def values(self, cloud: PointCloud) -> np.ndarray:
        values = cloud.attributes[self.of]
        if values.ndim > 1:
            values = values.reshape(len(values), -1)
            values = values[:, self.part] if self.part is not None else values
        return (
            values.astype(self.dtype) * self.dtype.type(self.factor) if self.factor != 1 else values.astype(self.dtype)
        )


def write(path: Path, stream: CloudStream) -> list[str]:
    """LAS or LAZ by the suffix; keeps the cloud's LAS header where it has one, else makes a 1.4 header."""
    survey = stream.survey
    header, warnings = header_for(survey)
    placed = place_attributes(header, survey, warnings)
    compress = path.suffix.lower() == ".laz"
    channels = survey.columns.get("scanner_channel")
    if compress and header.point_format.id in (9, 10) and channels is not None and channels.low != channels.high:
        waves = [p for p in placed if p.name in WAVEFORM_FIELDS_NAMES]
        placed = [p for p in placed if p not in waves]
        if waves:
            warnings.append("the waveform fields are left out, LAZ does not keep them for several channels: write .las")
    header.scales, header.offsets = scaling(survey, warnings)
    new_returns = survey.head.las_header is None and not {"return_number", "number_of_returns"} & {
        p.name for p in placed
    }
    with laspy.open(path, "w", header=header, do_compress=compress) as writer:
        for cloud in stream:
            record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
            counts = np.rint((cloud.points - header.offsets) / header.scales)
            for i, axis in enumerate("XYZ"):
                record[axis] = counts[:, i].astype(np.int32)
            for field in placed:
                record[field.name][:] = field.values(cloud)
            if new_returns:
                record["return_number"][:] = record["number_of_returns"][:] = 1
            writer.write_points(record)
        if header.evlrs and header.version.minor >= 4:
            writer.write_evlrs(header.evlrs)
    return warnings + [w for w in lost_context(survey.head, path.suffix) if "sensor" in w]


def header_for(survey: Survey) -> tuple[laspy.LasHeader, list[str]]:
    """A header of our own: a copy of the file's, or a new one with what the cloud needs."""
    warnings = []
    cloud = survey.head
    if cloud.las_header is None:
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.generating_software = "fmr"
    else:
        header = cloud.las_header.copy()
        if copc.info_of(header) is not None:
            warnings.append("the octree of COPC is left out: it is plain LAZ, `untwine` or `pdal` make a COPC of it")
            for records in (header.vlrs, header.evlrs or []):
                records[:] = [r for r in records if r.user_id != "copc"]
        if header.version.minor < 2:  # laspy writes 1.1 and later; 1.2 is the same with colours
            header.version = laspy.header.Version(1, 2)
        if header.global_encoding.waveform_data_packets_internal:
            warnings.append("the waveform packets are left out")
            header.global_encoding.value &= ~0b110
            header.start_of_waveform_data_packet_record = 0
            header.evlrs = header.evlrs and laspy.vlrs.vlrlist.VLRList(v for v in header.evlrs if v.record_id != 65535)
    if cloud.crs != crs_of(header):
        for records in (header.vlrs, header.evlrs or []):
            records[:] = [r for r in records if r.user_id != "LASF_Projection"]
        if cloud.crs:
            header.vlrs.append(crs_record(cloud.crs))
        header.global_encoding.wkt = bool(cloud.crs) and not str(cloud.crs).startswith("EPSG:")
    colors = [survey.columns.get(color) for color in COLORS]
    if header.point_format.id in WITH_COLORS and all(c is not None and fits(c, 0, 65535) for c in colors):
        old = header.point_format
        new = laspy.PointFormat(WITH_COLORS[old.id])
        new.dimensions += old.extra_dimensions
        version = max(header.version, laspy.LasHeader(point_format=new.id).version)
        header.set_version_and_point_format(version, new)
    return header, warnings


def crs_record(crs: str) -> Any:
    if not crs.startswith("EPSG:"):
        return WktCoordinateSystemVlr(crs)
    code = int(crs[5:])
    key, model = (GEOGRAPHIC, 2) if 4000 <= code < 5000 else (PROJECTED, 1)
    keys = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, model, key, 0, 1, code)
    return laspy.VLR("LASF_Projection", 34735, "GeoTiff GeoKeyDirectoryTag", keys)


def place_attributes(header: laspy.LasHeader, survey: Survey, warnings: list[str]) -> list[Placed]:
    """Finds each attribute a dimension: LAS's own where it holds the values exactly, else extra bytes of their type."""
    own = {d.name: d for d in header.point_format.standard_dimensions if d.name not in "XYZ"}
    declared = {d.name: d for d in header.point_format.extra_dimensions}
    placed: list[Placed] = []
    extra: dict[str, tuple[Placed, Column]] = {}
    for name, (field, column) in split(survey, warnings).items():
        if name in COLORS and name in own and column.dtype == np.uint8:
            placed.append(Placed(name, field.of, np.dtype(np.uint16), factor=257))  # LAS: colours that fill 16 bits
        elif name in own and fits(column, own[name].min, own[name].max, own[name].kind.letter() == "f"):
            placed.append(field)
        else:
            extra[name.capitalize() if name in own else name] = (field, column)
    stale = [n for n, d in declared.items() if n not in extra or not (d.is_scaled or same_type(d, extra[n][1]))]
    header.remove_extra_dims(stale)
    taken = [d.name for d in header.point_format.dimensions]
    for name, (field, column) in extra.items():
        if name in taken and name in declared and name not in stale:
            placed.append(Placed(name, field.of, field.dtype, field.part))
            continue
        short = unique([*taken, name.encode()[:30].decode(errors="ignore")])[-1]
        if short != name.capitalize() and short != name:
            warnings.append(f"attribute {name!r} is written as {short!r}, LAS names have at most 32 bytes")
        kind = field.dtype.newbyteorder("<").str[1:]
        width = int(np.prod(column.shape)) if column.shape else 0
        description = INTENSITY[1] if name == INTENSITY[0] and field.of == "intensity" else ""
        header.add_extra_dim(laspy.ExtraBytesParams(short, f"{width}{kind}" if width else kind, description))
        taken.append(short)
        placed.append(Placed(short, field.of, field.dtype, field.part))
    return placed


def split(survey: Survey, warnings: list[str]) -> dict[str, tuple[Placed, Column]]:
    """Attributes in types that LAS knows; (N, k) ones with k > 3 become k of their own.

    Up to 7 single bytes may stay together; laspy does not read back the declaration of more.
    """
    result: dict[str, tuple[Placed, Column]] = {}
    for name, column in survey.columns.items():
        dtype = column.dtype
        if dtype.kind not in "biuf":
            warnings.append(f"attribute {name!r} is not numeric: left out")
            continue
        if dtype.kind == "b":
            dtype = np.dtype(np.uint8)
        elif dtype.kind == "f" and dtype.itemsize not in (4, 8):
            dtype = np.dtype(np.float32 if dtype.itemsize < 4 else np.float64)
        width = int(np.prod(column.shape))
        if column.shape and width > 1 and width > (7 if dtype == np.uint8 else 3):
            single = replace(column, dtype=dtype, shape=())
            result |= {f"{name}_{k}": (Placed(f"{name}_{k}", name, dtype, k), single) for k in range(width)}
            warnings.append(f"attribute {name!r} is written as {name}_0 to {name}_{width - 1}")
        else:
            alone = column.shape and width == 1
            shape = () if alone or not column.shape else (width,)
            result[name] = (Placed(name, name, dtype, 0 if alone else None), replace(column, dtype=dtype, shape=shape))
    return result


def fits(column: Column, low: float, high: float, fraction: bool = False) -> bool:
    """Whether all values are single numbers within the limits and, without ``fraction``, integers."""
    if column.shape or column.dtype.kind not in "iuf":
        return False
    return fraction or (column.whole and column.low >= low and column.high <= high)


def same_type(dimension: Any, column: Column) -> bool:
    kind = np.dtype(dimension.type_str())
    return kind.base == column.dtype and kind.shape == column.shape


def scaling(survey: Survey, warnings: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Scales and offsets (3,) for which no coordinate leaves int32.

    The file's own scales stay unless the extent is too large for them, its offsets unless a point is too far away.
    Without a LAS header the scale is the power of ten that cuts the extent into 10⁸ to 10⁹ steps.
    """
    cloud, low, high = survey.head, survey.low, survey.high
    farthest = float(np.abs([low, high]).max())
    if farthest > 1e100:
        raise CloudFileError("coordinates beyond 1e100 do not fit into LAS, write .ply")
    extent = max(float((high - low).max()), farthest * 1e-9, 1e-100)
    own = cloud.las_header is not None and bool((cloud.las_header.scales > 0).all())
    if not own or not np.isfinite([cloud.las_header.scales, cloud.las_header.offsets]).all():
        scales = np.full(3, 10.0 ** (np.floor(np.log10(extent)) - 8))
        offsets = np.rint((low + high) / 2 / scales) * scales
        return scales, offsets
    scales, offsets = np.array(cloud.las_header.scales), np.array(cloud.las_header.offsets)
    for i in range(3):
        if reach(low[i], high[i], offsets[i]) / scales[i] < LARGEST:
            continue
        middle = (low[i] + high[i]) / 2
        while reach(low[i], high[i], middle) / scales[i] >= LARGEST - 1:
            scales[i] *= 10
        offsets[i] = np.rint(middle / scales[i]) * scales[i]
        if scales[i] != cloud.las_header.scales[i]:
            warnings.append(f"{'xyz'[i]} spans too much for LAS at the file's scale, it is now {scales[i]:g}")
    return scales, offsets


def reach(low: float, high: float, offset: float) -> float:
    return max(abs(low - offset), abs(high - offset))
