"""Errors for files that cannot be used. This module imports nothing."""


class FileError(ValueError):
    """A file that cannot be read. The message is one line that begins with its path."""


class CaptureError(FileError):
    """A capture that cannot be used, with a one-line message that names the remedy."""


# Errors of code that reads parsed JSON whose keys, types or values are unexpected.
UNEXPECTED_CONTENT = (
    LookupError,
    TypeError,
    AttributeError,
    ValueError,
    ArithmeticError,
    RecursionError,
)
