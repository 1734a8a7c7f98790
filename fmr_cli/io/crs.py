"""Coordinate reference systems as files state them: whether two are one, whether one is in degrees, reprojection."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import reason
from fmr_cli.io.stream import CloudStream

PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS")
GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "GEODCRS")
GEOCENTRIC = ("GEOCCS",)
TOKEN = re.compile(r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)\s*[\[(]|([\])])|([^,\s\[\]()"]+)')
SMALL = 2.0  # degrees: a scan is some kilometres wide, 200 km at the very most


@dataclass
class Node:
    """A part of WKT: PROJCS["name", ...]."""

    name: str
    words: list[str] = field(default_factory=list)
    parts: list[Node] = field(default_factory=list)

    def find(self, names: tuple[str, ...]) -> Node | None:
        """This part or the first below it that has one of the names."""
        if self.name in names:
            return self
        return next((found for part in self.parts if (found := part.find(names))), None)


def parse(wkt: str) -> Node:
    """The root of WKT, of whatever version; what is no WKT gives a root without parts."""
    root = Node("")
    stack = [root]
    for text, name, end, word in TOKEN.findall(wkt):
        if name:
            stack[-1].parts.append(Node(name.upper()))
            stack.append(stack[-1].parts[-1])
        elif end:
            if len(stack) > 1:
                stack.pop()
        else:
            stack[-1].words.append(word or text)
    return root


def horizontal(crs: str) -> Node | None:
    root = parse(crs)
    return root.find(PROJECTED) or root.find(GEOGRAPHIC) or root.find(GEOCENTRIC)


def code_of(crs: str) -> str | None:
    """The code ``EPSG:n`` of the horizontal system, where it is stated."""
    if re.fullmatch(r"EPSG:\d+", crs.strip(), re.IGNORECASE):
        return crs.strip().upper()
    node = horizontal(crs)
    stated = next((p for p in node.parts if p.name in ("AUTHORITY", "ID")), None) if node else None
    return ":".join(stated.words[:2]).upper() if stated and len(stated.words) >= 2 else None


def name_of(crs: str) -> str:
    """The system's name for people, and its code."""
    node, code = horizontal(crs), code_of(crs)
    name = node.words[0] if node and node.words else crs.strip()[:60]
    return f"{name} ({code})" if code and code != name else name


def same(a: str, b: str) -> bool | None:
    """Whether two are one system in the plane; None where neither codes nor names tell and pyproj is not there."""
    if a == b or bare_name(a) == bare_name(b):
        return True
    if code_of(a) and code_of(b):
        return code_of(a) == code_of(b)
    try:
        import pyproj
    except ImportError:
        return None
    try:
        return bool(pyproj.CRS(a).to_2d().equals(pyproj.CRS(b).to_2d(), ignore_axis_order=True))
    except Exception:  # one that pyproj does not know either
        return None


def bare_name(crs: str) -> str:
    """A name as all programs spell it: "WGS 84 / UTM zone 33N" and "WGS_1984_UTM_Zone_33N" are one."""
    node = horizontal(crs)
    name = node.words[0] if node and node.words else code_of(crs) or crs
    return re.sub(r"[^a-z0-9]", "", name.lower()).replace("1984", "84").replace("1983", "83")


def in_degrees(crs: str, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether coordinates within low and high, (3,) each, are longitudes and latitudes, as the system says."""
    node = horizontal(crs)
    code = code_of(crs) or ""
    geographic = node.name in GEOGRAPHIC if node else re.fullmatch(r"EPSG:4\d{3}", code)
    fits = (np.abs([low[:2], high[:2]]) <= [360, 90]).all() and (high[:2] - low[:2] < SMALL).all()
    return bool(geographic and fits)


def reprojected(stream: CloudStream, wanted: str) -> CloudStream:
    """The cloud in another system, which is all that pyproj knows: "EPSG:32633", WKT, a PROJ string.

    Raises CloudFileError where the cloud has no system, either is unknown, or pyproj is not there.
    """
    try:
        import pyproj
    except ImportError:
        raise CloudFileError("--crs needs pyproj: pip install 'fmr-cli[crs]'") from None
    given = stream.survey.head.crs
    if not given:
        raise CloudFileError(f"{stream.name}: states no coordinate reference system, so there is nothing to go from")
    try:
        old, new = pyproj.CRS.from_user_input(given), pyproj.CRS.from_user_input(wanted)
        to: Any = pyproj.Transformer.from_crs(old, new, always_xy=True)
        try:
            text = new.to_wkt("WKT1_GDAL")
        except pyproj.exceptions.CRSError:
            text = new.to_wkt()
    except pyproj.exceptions.ProjError as error:
        raise CloudFileError(f"--crs {wanted}: {reason(error)}, give one such as EPSG:32633") from error

    def moved(cloud: PointCloud) -> PointCloud:
        points = np.stack(to.transform(*cloud.points.T), 1)
        if not np.isfinite(points).all():
            raise CloudFileError(f"{cloud.name}: has points outside the area of {new.name}, choose another --crs")
        header = cloud.las_header
        if header is not None:
            header = header.copy()
            header.scales = np.zeros(3)  # those of degrees are none of metres: they are chosen anew
        origin = cloud.sensor_origin
        origin = origin if origin is None else np.array(to.transform(*origin), float)
        return replace(
            cloud, points=points, crs=text, las_header=header, sensor_origin=origin, scan=None, T_file_scan=None
        )

    return stream.map(moved)
