"""What a user can get wrong, as exceptions whose text is the one line that is shown."""


class FmrError(Exception):
    """Bad input. The message names the file (or option), what is wrong, and what to do; the command exits with 2."""


class CloudFileError(FmrError):
    """A point cloud, transform or manifest file that cannot be read or written as asked."""


class RegistrationError(FmrError):
    """Two clouds that cannot be registered at all (too few points, all in one place)."""


class ModelError(FmrError):
    """Weights that do not fit the architecture, or a device that is not there."""


class OptionsError(FmrError):
    """An option that is unknown, out of its range, or at odds with another one."""
