"""All suites of arms by name; no JAX."""

from experiments.ablate_arms import FIELDS, MOBA, SONATA
from experiments.accuracy_axes import SETTINGS
from experiments.inspect_arms import ADVICE

SUITES = {
    "fields": FIELDS,
    "sonata": SONATA,
    "moba": MOBA,
    "settings": SETTINGS,
    "advice": ADVICE,
}
