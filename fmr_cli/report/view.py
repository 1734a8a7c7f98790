"""What `fmr view` shows: clouds in one frame, coloured and cut; in a window of Open3D, as a picture, or as a page."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.geometry.sampling import sample
from fmr_cli.io import read_cloud, read_transform
from fmr_cli.io.stream import COLORS, CloudStream, collect
from fmr_cli.report.networks import number_of
from fmr_cli.report.page import write_page
from fmr_cli.report.points import SOURCE, TARGET, packed, packed_shares, raw

Coloring = Literal["file", "height", "intensity", "rgb", "residual"]
IN_WINDOW, ON_PAGE = 2_000_000, 120_000  # points of all clouds together
MEASURED = 200_000  # points of a cloud that residuals are measured to
SLICE = 0.02  # of the size: a section's thickness where none is given
STEP = 0.01  # of the size: by which a key moves a section
# Of clouds by file: those of the reports, then others told apart with every kind of colour vision (Okabe and Ito)
HUES = np.array([TARGET, SOURCE, (0, 158, 115), (204, 121, 167), (86, 180, 233), (120, 94, 240)]) / 255
# From few to many, light growing evenly enough to read in grey; the same on pages (clouds.js)
RAMP = np.array([(36, 92, 190), (42, 143, 189), (143, 199, 122), (242, 193, 78), (200, 50, 31)]) / 255
SCREEN = (1280, 960)


@dataclass(frozen=True)
class Section:
    """A slice of the clouds: along ``axis`` (0 to 2) at ``at``, so thick; own unit."""

    axis: int
    at: float
    thick: float

    def keep(self, points: np.ndarray) -> np.ndarray:
        return np.abs(points[:, self.axis] - self.at) <= self.thick / 2


def read_section(text: str | None, clouds: Sequence[PointCloud]) -> Section | None:
    """A section as given: AXIS, AXIS=AT or AXIS=AT:THICK, such as z=1.5:0.1. Raises FmrError."""
    if text is None:
        return None
    axis, _, rest = text.partition("=")
    at, _, thick = rest.partition(":")
    low, high = box(clouds)
    try:
        number = "xyz".index(axis.strip().lower()) if axis.strip() else -1
        section = Section(
            number,
            float(at) if at else float(np.median(np.concatenate([c.points[:, number] for c in clouds]))),
            float(thick) if thick else SLICE * float(np.linalg.norm(high - low)),
        )
    except ValueError:
        number = -1
    if number < 0 or not section.thick > 0 or not np.isfinite([section.at, section.thick]).all():
        raise FmrError(f"--section {text}: give an axis and where to cut, such as z, z=1.5 or z=1.5:0.1 (0.1 thick)")
    return section


def box(clouds: Sequence[PointCloud]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) of all clouds."""
    return np.min([c.points.min(0) for c in clouds], axis=0), np.max([c.points.max(0) for c in clouds], axis=0)


def load(
    files: Sequence[Path], transform: Path | None, result: Path | None, at_most: int
) -> tuple[list[PointCloud], list[str]]:
    """The clouds in one frame, at most so many points together, and what a person should know.

    transform: moves the first file. result: the folder of a multiway run, whose poses move the scans (all of them where
    no file is named), or of a batch, whose pair of two files it is. Raises FmrError.
    """
    notes: list[str] = []
    poses: list[np.ndarray] = [np.eye(4)] * len(files)
    if result is not None:
        files, poses, notes = of_result(result, files)
    elif not files:
        raise FmrError("give files to view, or --result with the folder of a run")
    if transform is not None:
        poses = [read_transform(transform), *poses[1:]]
    clouds = []
    for file, T in zip(files, poses, strict=True):
        cloud = read_cloud(file, at_most=max(at_most // len(files) // 2, 1000))
        clouds.append(cloud if np.array_equal(T, np.eye(4)) else cloud.transformed(T))
        if len(cloud) < cloud.count:
            notes.append(f"{file}: {len(cloud)} of {cloud.count} points are shown")
    return clouds, notes


def of_result(folder: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    """The files of a run and their poses in one frame."""
    if (folder / "network.json").is_file():
        return of_network(folder / "network.json", files)
    if (folder / "results.csv").is_file():
        return of_batch(folder, files)
    raise CloudFileError(f"{folder}: holds neither network.json (fmr multiway) nor results.csv (fmr batch)")


def of_network(path: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    try:
        scans = json.loads(path.read_text("utf-8"))["scans"]
        known = [(Path(s["file"]), s["component"], s["T_component_scan"], s["name"]) for s in scans]
    except (ValueError, KeyError, TypeError) as error:
        raise CloudFileError(f"{path}: is not what fmr multiway writes ({error})") from None
    wanted = {file.resolve() for file in files}
    chosen = [s for s in known if not wanted or s[0].resolve() in wanted]
    for file in files:
        if file.resolve() not in {s[0].resolve() for s in known}:
            raise CloudFileError(f"{file}: is not among the scans of {path}")
    first = min((s[1] for s in chosen if s[1] is not None), default=None)
    placed = [s for s in chosen if s[1] == first and s[2] is not None]
    if not placed:
        raise CloudFileError(f"{path}: none of these scans is placed")
    left = [s[3] for s in chosen if s not in placed]
    notes = [f"in other frames, not shown: {', '.join(left[:20])}"] if left else []
    return [s[0] for s in placed], [np.array(s[2]) for s in placed], notes


def of_batch(folder: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    import csv

    if len(files) != 2:
        raise FmrError(f"{folder}: of a batch one pair is shown, give its SOURCE and TARGET")
    with (folder / "results.csv").open(encoding="utf-8", newline="") as table:
        for row in csv.DictReader(table):
            names = [Path(row.get("source") or "").name, Path(row.get("target") or "").name]
            if names == [file.name for file in files] and row.get("transform"):
                return list(files), [read_transform(folder / row["transform"]), np.eye(4)], []
    raise CloudFileError(f"{folder / 'results.csv'}: has no transform of {files[0].name} onto {files[1].name}")


def with_residuals(clouds: list[PointCloud]) -> list[PointCloud]:
    """Each with the distances of its points to the nearest point of the others, as attribute ``residual``."""
    rng = np.random.default_rng(0)
    some = [sample(c.points, MEASURED // len(clouds), rng) for c in clouds]
    found = []
    for n, cloud in enumerate(clouds):
        others = np.concatenate([p for k, p in enumerate(some) if k != n])
        found.append(cloud.with_attribute("residual", cKDTree(others).query(cloud.points)[0]))
    return found


def values_of(cloud: PointCloud, by: Coloring) -> np.ndarray | None:
    """The numbers (N,) that a cloud is coloured by; None where it has none."""
    if by == "height":
        return cloud.points[:, 2]
    values = cloud.attributes.get(by)
    return None if values is None or values.ndim != 1 else values.astype(float)


def rgb_of(cloud: PointCloud) -> np.ndarray | None:
    """The points' own colours (N, 3) from 0 to 1, or None."""
    if not all(name in cloud.attributes for name in COLORS):
        return None
    rgb = np.stack([cloud.attributes[name] for name in COLORS], 1).astype(float)
    most = float(rgb.max(initial=0.0))
    return rgb / (1.0 if most <= 1 else 255.0 if most <= 255 else 65535.0)


def colors(clouds: Sequence[PointCloud], by: Coloring) -> list[np.ndarray]:
    """Of each cloud's points (N, 3), from 0 to 1; what has not what is asked for is coloured by file."""
    values = [values_of(c, by) for c in clouds] if by not in ("file", "rgb") else [None] * len(clouds)
    known = [v for v in values if v is not None and len(v)]
    low, high = np.quantile(np.concatenate(known), [0.02, 0.98]) if known else (0.0, 1.0)
    found = []
    for n, (cloud, value) in enumerate(zip(clouds, values, strict=True)):
        own = rgb_of(cloud) if by == "rgb" else None
        if value is not None:
            share = np.clip((np.nan_to_num(value) - low) / max(high - low, 1e-300), 0, 1) * (len(RAMP) - 1)
            own = np.stack([np.interp(share, np.arange(len(RAMP)), channel) for channel in RAMP.T], 1)
        found.append(np.tile(HUES[n % len(HUES)], (len(cloud), 1)) if own is None else own)
    return found


def missing(clouds: Sequence[PointCloud], by: Coloring) -> list[str]:
    """A line for clouds that do not have what they are to be coloured by."""
    lacking = [
        c.name for c in clouds
        if (by == "rgb" and rgb_of(c) is None) or (by not in ("rgb", "file") and values_of(c, by) is None)
    ]  # fmt: skip
    return [f"{', '.join(lacking[:3])}: no {by}, coloured by file"] if lacking else []


class Window:
    """Open3D's window of clouds, or its picture of them. Coordinates in it are relative to the clouds' middle."""

    def __init__(self, clouds: list[PointCloud], by: Coloring, size: float, section: Section | None) -> None:
        from fmr_cli.evaluation.open3d_import import open3d

        self.o3d, self.clouds, self.by, self.size, self.section = open3d(), clouds, by, size, section
        self.low, self.high = box(clouds)
        self.middle, self.extent = (self.low + self.high) / 2, float(np.linalg.norm(self.high - self.low))
        self.shown = [self.o3d.geometry.PointCloud() for _ in clouds]
        self.color()

    def color(self) -> None:
        self.rgb = colors(self.clouds, self.by)
        self.cut()

    def cut(self) -> None:
        """Puts what the section leaves, or all, into the geometries."""
        for cloud, rgb, shown in zip(self.clouds, self.rgb, self.shown, strict=True):
            keep = self.section.keep(cloud.points) if self.section else slice(None)
            shown.points = self.o3d.utility.Vector3dVector(cloud.points[keep] - self.middle)
            shown.colors = self.o3d.utility.Vector3dVector(rgb[keep])

    def open(self, window: Any, visible: bool) -> None:
        """Raises FmrError where there is no screen, or none can be made up."""
        os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # Mesa complains where there is none
        with quiet_natives(self.o3d):
            made = window.create_window("fmr view", *SCREEN, visible=visible)
        if not made:
            raise FmrError(
                "this machine cannot draw (no screen, and no OpenGL without one; on Debian: apt install libegl1 "
                "libgl1-mesa-dri); --html FILE writes a page instead"
            )
        for shown in self.shown:
            if shown.has_points():
                window.add_geometry(shown)
        options = window.get_render_option()
        options.point_size, options.background_color = self.size, np.ones(3)
        control = window.get_view_control()
        along = [(1, 0, 0), (0, -1, 0), (0, 0, 1)][self.section.axis] if self.section else (0.6, -0.6, 0.55)
        control.set_front(np.array(along) / np.linalg.norm(along))
        control.set_up((0, 1, 0) if self.section and self.section.axis == 2 else (0, 0, 1))
        control.set_lookat(np.zeros(3))
        control.set_zoom(0.6)

    def save(self, path: Path) -> None:
        """A picture, also without a screen where the machine allows. Raises FmrError."""
        from fmr_cli.io import atomic_write

        window = self.o3d.visualization.Visualizer()
        self.open(window, visible=False)
        window.poll_events()
        window.update_renderer()
        with atomic_write(path) as temporary:
            window.capture_screen_image(str(temporary), True)
            if not temporary.exists():
                raise FmrError(f"{path}: Open3D could not write this picture")
        window.destroy_window()

    def run(self) -> None:
        """The window until it is closed. Keys: 1 to 5 colours; X, Y, Z a section, again none; [ and ] move it."""
        check_screen()
        window = self.o3d.visualization.VisualizerWithKeyCallback()
        self.open(window, visible=True)

        def changed(change: Any) -> Any:
            def act(_: Any) -> bool:
                change()
                for shown in self.shown:
                    window.update_geometry(shown)
                return True

            return act

        for number, by in enumerate(get_args(Coloring), 1):
            window.register_key_callback(ord(str(number)), changed(lambda by=by: self.color_by(by)))
        for axis, key in enumerate("XYZ"):
            window.register_key_callback(ord(key), changed(lambda axis=axis: self.cut_along(axis)))
        for key, step in (("[", -STEP), ("]", STEP)):
            window.register_key_callback(ord(key), changed(lambda step=step: self.move(step)))
        window.run()
        window.destroy_window()

    def color_by(self, by: Coloring) -> None:
        self.by = by
        self.color()

    def cut_along(self, axis: int) -> None:
        """A section along an axis in the middle; none where there is that one already."""
        off = self.section is not None and self.section.axis == axis
        self.section = None if off else Section(axis, float(self.middle[axis]), SLICE * self.extent)
        self.cut()

    def move(self, step: float) -> None:
        if self.section:
            self.section = replace(self.section, at=self.section.at + step * self.extent)
            self.cut()


def check_screen() -> None:
    """Raises FmrError where a window would have no screen."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise FmrError(
            "no screen here (DISPLAY is not set); fmr view --screenshot FILE.png or --html FILE works without one"
        )


def view_pair(source: CloudStream, target: CloudStream, T_target_source: np.ndarray) -> None:
    """The window with a registered pair, until it is closed."""
    clouds = [collect(source.transformed(T_target_source), IN_WINDOW // 4), collect(target, IN_WINDOW // 4)]
    Window(with_residuals(clouds), "file", 2.0, None).run()


def quiet_natives(o3d: Any) -> Any:
    """Open3D says on stdout what it does where there is no screen; what fails comes back as a value as well."""
    return o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)


def write_view(path: Path, clouds: list[PointCloud], by: Coloring, size: float, section: Section | None) -> None:
    """The clouds as a page that needs no network."""
    low, high = box(clouds)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    each = max(ON_PAGE // len(clouds), 500)
    rng = np.random.default_rng(0)
    few = [c.select(rng.permutation(len(c))[:each]) for c in clouds]
    scales: dict[str, dict[str, Any]] = {}
    drawn: list[dict[str, Any]] = [
        {"name": c.path.name if c.path else c.name, "points": packed(c.points - middle), "values": {}} for c in few
    ]
    for name in ("height", "intensity", "residual"):
        values = [values_of(c, name) for c in few]  # type: ignore[arg-type]
        known = [v for v in values if v is not None and len(v)]
        if not known:
            continue
        least, most = (float(x) for x in np.quantile(np.concatenate(known), [0.02, 0.98]))
        scales[name] = {"low": number_of(least), "high": number_of(most), "name": name, "open": True}
        for cloud, value in zip(drawn, values, strict=True):
            if value is not None:
                cloud["values"][name] = packed_shares(value - least, most - least)
    for cloud, c in zip(drawn, few, strict=True):
        rgb = rgb_of(c)
        cloud["rgb"] = None if rgb is None else raw((255 * rgb).round().astype(np.uint8))
    offers = ["file", *scales, *(["rgb"] if any(c["rgb"] for c in drawn) else [])]
    data = {"clouds": drawn, "scales": scales, "size": extent, "section": section and {
        "axis": section.axis, "at": section.at - float(middle[section.axis]), "thick": section.thick,
    }}  # fmt: skip
    write_page(
        path, "view.html", data, ("clouds.js", "view.js"), title=", ".join(str(c["name"]) for c in drawn[:4])
        + (f" and {len(drawn) - 4} more" if len(drawn) > 4 else ""), offers=offers, by=by if by in offers else "file",
        size=size, middle=middle.tolist(), files=[(c.name, c.count, len(f)) for c, f in zip(clouds, few, strict=True)],
    )  # fmt: skip
