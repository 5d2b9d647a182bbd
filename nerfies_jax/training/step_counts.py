"""Step counts in specs, which are scaled with the length of a run."""

import dataclasses
from typing import Any

_MARK = "steps"


def steps(default: Any = dataclasses.MISSING) -> Any:
    """Declare a field of a frozen dataclass that counts steps.

    Args:
      default: Default value.

    Returns:
      The field, for use as `warm_up: int = steps(3000)`.
    """
    return dataclasses.field(default=default, metadata={_MARK: True})


def scale_steps(spec: Any, share: float) -> Any:
    """Scale every step count of a spec, also in nested specs.

    Args:
      spec: A frozen dataclass.
      share: Factor.

    Returns:
      The spec with scaled counts of at least 1. Counts of 0 and None mean that there
      are no such steps and do not change. Multiples of ten remain multiples of ten
      from a hundred on, to fit the length of scans.
    """
    changes = {}
    for field in dataclasses.fields(spec):
        value = getattr(spec, field.name)
        if field.metadata.get(_MARK) and value:
            unit = 10 if value % 10 == 0 and value * share >= 100 else 1
            changes[field.name] = max(1, unit * round(value * share / unit))
        elif dataclasses.is_dataclass(value):
            changes[field.name] = scale_steps(value, share)
    return dataclasses.replace(spec, **changes)
