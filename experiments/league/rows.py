"""The rows of the league: small presets, with and without a start from tracks."""

from experiments.ablate.arms import Arm, Claim, Suite
from nerfies_jax.runs import representations
from nerfies_jax.training import specs

JUDGED = ("psnr", "moving_psnr", "track_error")  # the best against each other row
OTHER_START = {"none": "tracks", "tracks": "none"}
SUFFIX = {"none": "+rest", "tracks": "+tracks"}
# Sonata learns depth, which is exact in built-in films and read by none of its rivals.
LESS = {"sonata-small": ("no-depth", "depth=none")}


def suite() -> Suite:
    """All rows as one suite; nothing is claimed before the numbers are there."""
    return Suite(arms=dict(_rows()), claims=(), seeds=3, pictured=(), context="")


def of_presets(presets: tuple[str, ...]) -> tuple[str, ...]:
    """The rows of some presets, or of all; ValueError for what is no small preset."""
    arms = suite().arms
    small = dict.fromkeys(arm.preset for arm in arms.values())
    for name in presets:
        if name not in small:
            raise ValueError(f"--presets {name}: choose from {', '.join(small)}")
    return tuple(n for n, arm in arms.items() if arm.preset in (presets or small))


def against_best(best: str, others: list[str]) -> list[Claim]:
    """That one row is better than each of the others."""
    return [Claim(f"`{best}` is the best", best, other, JUDGED) for other in others]


def _rows():
    """A preset as it is, and started the other way where its motion can be."""
    for name, arm in _started():
        yield name, arm
        if arm.preset in LESS:
            word, change = LESS[arm.preset]
            yield f"{name}+{word}", Arm(arm.preset, (*arm.changes, change))


def _started():
    for preset in representations.PRESETS:
        if not preset.endswith("-small"):
            continue
        spec = representations.of_preset(preset).presets[preset]
        yield preset, Arm(preset)
        start = OTHER_START[spec.start.motion]
        change = f"start.motion={start}"
        if getattr(spec, "motion", spec) is None:  # splats that stand still
            continue
        try:
            specs.override(spec, (change,))
        except ValueError:  # nothing in it could be fitted to tracks
            continue
        yield preset + SUFFIX[start], Arm(preset, (change,))
