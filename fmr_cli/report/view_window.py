"""`fmr view` in a window of Open3D, or its picture without a screen."""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import FmrError
from fmr_cli.io.stream import CloudStream, collect
from fmr_cli.report.coloring import Coloring, colors, with_residuals
from fmr_cli.report.view_clouds import SLICE, Section, box

IN_WINDOW = 2_000_000  # points of all clouds together
STEP = 0.01  # of the size: by which a key moves a section
SCREEN = (1280, 960)


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
