"""The pages of `experiments.ablate` in docs/results."""

import math

from experiments import markdown
from experiments.ablate import measures, suites
from experiments.ablate.measures import COSTS, MEASURES


def page(stored) -> str:
    """Everything below the docstring, from an ablation.json."""
    about = stored["about"]
    means = measures.stored_means(stored["metrics"])
    spreads = measures.stored_means(stored["metrics"], spread=True)
    still = stored["metrics"]["still.track_error"]["value"]
    numbers = {(arm, 0): row for arm, row in means.items()}
    shown = measures.shown(numbers)
    parts = [
        f"## {about['capture']}, suite `{about['settings']['suite']}`",
        _trained(about),
        "What an arm changes in its preset:",
        _arms(about, means),
        _table(means, spreads, [name for name in shown if name not in COSTS]),
        _table(means, spreads, [name for name in shown if name in COSTS]),
        markdown.bullets(
            measures.legend(shown).replace("\n", " ").replace(". ", ".\n").split("\n")
        ),
    ]
    if still is not None:
        parts.append(f"Points that do not move have an EPE of {still:.4f} scene units.")
        rest = [
            arm for arm, row in means.items() if _same(row.get("track_error"), still)
        ]
        if rest:
            names = ", ".join(f"`{arm}`" for arm in rest)
            parts.append(
                f"That of {names} is the same: nothing there has left its place, and a "
                "verdict on it is one on a scene at rest."
            )
    if about["claims"]:
        parts += ["## What it says of the claims", _claims(about["claims"])]
    context = suites.named(about["settings"]["suite"]).context
    return "\n\n".join([*parts, context] if context else parts)


def _same(error, still):
    return error is not None and abs(error - still) < 1e-6


def _trained(about):
    changed = " ".join(about["settings"]["set"])
    count = max(map(len, about["seeds"].values()))
    seeds = f"{count} seeds; ± is their standard deviation"
    if count == 1:
        seeds = "one seed, which has no spread"
    return (
        f"Every arm was trained {about['trained']}, with {seeds}. The last iterate "
        f"counts.{f' All with --set {changed}.' if changed else ''}"
    )


def _arms(about, means):
    rows = []
    for arm in means:
        about_arm = about["arms"][arm]
        words = [about_arm["preset"], *about_arm["changes"]]
        # As those that were kept before an arm could be told the truth.
        if about_arm.get("told"):
            words.append("from the scene's own points, where they are at every moment")
        rows.append([f"`{arm}`", " ".join(words)])
    return markdown.table(("arm", "trained with"), rows, words=2)


def _table(means, spreads, names):
    rows = []
    for arm, row in means.items():
        cells = [f"`{arm}`"]
        for name in names:
            spread = spreads.get(arm, {}).get(name, math.nan)
            digits = MEASURES[name].digits
            cells.append(markdown.with_spread(row[name], spread, digits))
        rows.append(cells)
    return markdown.table(("arm", *(MEASURES[name].heading for name in names)), rows)


def _claims(claims):
    rows = []
    for claim in claims:
        gain = markdown.short(claim["gain"])
        if claim["half_width"] is not None:
            gain += f" ± {markdown.short(claim['half_width'])}"
        better, worse = claim["arms"]
        statement = f"{claim['claim']}: `{better}` against `{worse}`"
        rows.append([statement, claim["measure"], gain, claim["says"]])
    heads = ("claim", "by", "gain", "which")
    return markdown.table(heads, rows, words=4) + (
        "\n\n± of a gain is its 95 % interval (Student, seeds paired); a gain is "
        "positive where the claim is right."
    )
