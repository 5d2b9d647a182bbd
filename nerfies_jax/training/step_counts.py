"""Fields of a spec that count steps, so that a schedule can follow the run's length."""

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


def stretched(spec: Any, share: float) -> Any:
    """Scale every step count of a spec, also in nested specs.

    Args:
      spec: A frozen dataclass.
      share: Factor.

    Returns:
      The spec with scaled counts. A count is at least 1, and 0 and None, which mean
      that there is none, stay. Multiples of ten from a hundred on stay multiples of
      ten, as scans need them.
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
