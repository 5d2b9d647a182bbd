"""All suites of arms by name; no JAX until one needs it."""

import functools

from experiments.ablate.arms import FIELDS, MOBA, SONATA, Suite
from experiments.ablate.open_arms import LAZY, OPEN, RATE
from experiments.ablate.start_arms import POSES, START, TRACKED_PARTS, VIEWS

KEPT = {
    "fields": FIELDS,
    "start": START,
    "tracked": TRACKED_PARTS,
    "poses": POSES,
    "sonata": SONATA,
    "moba": MOBA,
    "open": OPEN,
    "rate": RATE,
    "views": VIEWS,
    "lazy": LAZY,
}


@functools.cache
def named(name: str) -> Suite:
    """The suite of that name."""
    if name == "league":
        from experiments.league.rows import suite

        return suite()
    return KEPT[name]
