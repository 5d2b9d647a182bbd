"""The page of `experiments.fuzz` in docs/results."""

from experiments import markdown


def page(results: dict) -> str:
    """Count the damaged files that each reader read or refused, and the failures."""
    rows, failures = [], []
    for name, target in results["targets"].items():
        wrong = sum(target["failures"].values())
        cells = (target["mutations"], target["read"], target["refused"], wrong)
        rows.append(
            [
                name,
                *(f"{cell:,}" for cell in cells),
                markdown.number(target["seconds"], 2),
                markdown.number(target["bytes"] / 2**20, 0),
            ]
        )
        failures += [
            f"{name}: {failure} ({n} times)"
            for failure, n in target["failures"].items()
        ]
    total = sum(target["mutations"] for target in results["targets"].values())
    wrong = sum(
        sum(target["failures"].values()) for target in results["targets"].values()
    )
    heads = (
        *("reader", "files", "read", "refused", "failures"),
        *("longest, CPU s", "growth, MB"),
    )
    parts = [
        f"Of {total:,} damaged files {wrong:,} were neither read nor refused with the "
        f"file's path ({_revisions(results)}).",
        markdown.table(heads, rows),
    ]
    if failures:
        parts += ["What went wrong:", markdown.bullets(failures)]
    return "\n\n".join(parts)


def _revisions(results):
    names = [str(name)[:12] for name in results["revisions"]]
    return ("revision " if len(names) == 1 else "revisions ") + ", ".join(names)
