"""All suites by name, without JAX until one needs it."""

from experiments.ablate.arms import FIELDS, MOBA, SONATA, Arm, Suite
from experiments.ablate.tracked_arms import POSES, TRACKED_PARTS
from nerfies_jax.runs.representations import PRESETS

SMALL = {name: Arm(name) for name in PRESETS if name.endswith("-small")}
KEPT = {
    "fields": FIELDS,
    "tracked": TRACKED_PARTS,
    "poses": POSES,
    "sonata": SONATA,
    "moba": MOBA,
    "presets": Suite(arms=SMALL, claims=(), seeds=3, pictured=(), context=""),
}


def named(name: str) -> Suite:
    """The suite of that name."""
    return KEPT[name]
