"""What may move, by name. Apart from ``motion``, so that the command line knows the names without numpy."""

from typing import Literal

Dof = Literal["rigid", "yaw", "translation", "planar"]
