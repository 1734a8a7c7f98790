"""The one place that imports Open3D, which only the baseline FPFH + RANSAC needs, and only when it runs."""

from __future__ import annotations

import functools
import importlib
import sys
from typing import Any

from fmr_cli.errors import FmrError

# Debian's packages of the shared libraries that Open3D's wheels for Linux expect of the system, by `ldd` on its
# pybind module; each is found missing by the dynamic linker, which names the library.
SYSTEM_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL.so": "libgl1",
    "libEGL.so": "libegl1",
    "libX11.so": "libx11-6",
}


class Open3DError(FmrError):
    """Open3D is not installed, or lacks a library of the system."""


@functools.cache
def open3d() -> Any:
    """The module ``open3d``, silent but for errors. Raises Open3DError: which package is missing, how to install it."""
    try:
        module = importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        package = "open3d-cpu" if sys.platform == "linux" else "open3d"
        raise Open3DError(f"Open3D cannot be imported ({error}); pip install {package}") from None
    except (ImportError, OSError) as error:
        missing = [package for library, package in SYSTEM_PACKAGES.items() if library in str(error)]
        packages = " ".join(missing or SYSTEM_PACKAGES.values())
        raise Open3DError(f"Open3D lacks a system library ({error}); on Debian: apt install {packages}") from None
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module
