"""Fields of a spec that count steps, so that a schedule can follow the run's length."""

import dataclasses
from typing import Any

_MARK = "steps"


def steps(default: Any = dataclasses.MISSING) -> Any:
    """A field of a frozen dataclass that counts steps: `warm_up: int = steps(3000)`."""
    return dataclasses.field(default=default, metadata={_MARK: True})


def stretched(spec: Any, share: float) -> Any:
    """The same settings with every count of steps times `share`, in all parts.

    A count stays at least 1; 0 and None say that there is none, and stay. One that
    was a multiple of ten is one again from a hundred on: so are the scans of a run.
    """
    changes = {}
    for field in dataclasses.fields(spec):
        value = getattr(spec, field.name)
        if field.metadata.get(_MARK) and value:
            unit = 10 if value % 10 == 0 and value * share >= 100 else 1
            changes[field.name] = max(1, unit * round(value * share / unit))
        elif dataclasses.is_dataclass(value):
            changes[field.name] = stretched(value, share)
    return dataclasses.replace(spec, **changes)
