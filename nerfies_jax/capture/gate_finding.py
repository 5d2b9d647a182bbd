"""The result of one check of a capture."""

from typing import NamedTuple


class Finding(NamedTuple):
    """Value that a check measured, and the problem that it shows, if any."""

    subject: str  # what was checked, a few words
    value: str  # what was measured
    problem: str = ""  # what is wrong, the likely reason and what to do; empty if fine
    refused: bool = False  # whether nothing can be right
