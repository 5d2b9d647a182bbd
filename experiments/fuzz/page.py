"""The page of `experiments.fuzz` in docs/results."""

from experiments import markdown


def page(stored: dict) -> str:
    """Count the damaged files that each reader read or refused, and the failures."""
    rows, failures = [], []
    for name, one in stored["targets"].items():
        wrong = sum(one["failures"].values())
        cells = (one["mutations"], one["read"], one["refused"], wrong)
        rows.append(
            [
                name,
                *(f"{cell:,}" for cell in cells),
                markdown.number(one["seconds"], 2),
                markdown.number(one["bytes"] / 2**20, 0),
            ]
        )
        failures += [
            f"{name}: {what} ({n} times)" for what, n in one["failures"].items()
        ]
    total = sum(one["mutations"] for one in stored["targets"].values())
    wrong = sum(sum(one["failures"].values()) for one in stored["targets"].values())
    heads = (
        *("reader", "files", "read", "refused", "failures"),
        *("longest, CPU s", "growth, MB"),
    )
    parts = [
        f"Of {total:,} damaged files {wrong:,} were neither read nor refused with the "
        f"file's path ({_revisions(stored)}).",
        markdown.table(heads, rows),
    ]
    if failures:
        parts += ["What went wrong:", markdown.bullets(failures)]
    return "\n\n".join(parts)


def _revisions(stored):
    names = [str(name)[:12] for name in stored["revisions"]]
    return ("revision " if len(names) == 1 else "revisions ") + ", ".join(names)
