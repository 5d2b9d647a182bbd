"""Table, sentences and the figure of `experiments.motion_rank`."""

from typing import Any

import numpy as np

from experiments import asked, markdown
from nerfies_jax import console
from nerfies_jax.capture.json_files import replaced_file, write_json
from nerfies_jax.evaluation import figures
from nerfies_jax.measure import clock

COLORS = {
    "time basis": "C3",
    "separable": "C1",
    "moving basis": "C0",
    "residual": "0.35",
}
# What direct supervision showed when the design was made, with slack.
TIME_GATE = 0.5  # the moving basis has at most this share of the time basis' error
RESIDUAL_GATE = 1.3  # and at least 1 / this of the residual's: the basis is not why


def progress(row) -> str:
    """One line for a model that is done."""
    count = "" if row.count is None else f" K={row.count}"
    return (
        f"{row.kind} {row.model}{count}: {np.mean(row.learned):.4f}, held out "
        f"{np.mean(row.held_out):.4f}, {row.seconds:.1f} s"
    )


def text(rows) -> str:
    """One line for each model and K."""
    lines = [
        f"\n{'tracks':8s} {'model':13s} {'K':>3s} {'learned':>16s} "
        f"{'held out':>16s} {'floor':>8s} {'CPU s':>6s}"
    ]
    for row in rows:
        floor = f"{np.mean(row.floor):8.4f}" if row.floor else f"{'-':>8s}"
        lines.append(
            f"{row.kind:8s} {row.model:13s} {row.count or '-':>3} "
            f"{markdown.over_seeds(row.learned, 4):>16s} "
            f"{markdown.over_seeds(row.held_out, 4):>16s} {floor} {row.seconds:6.2f}"
        )
    return "\n".join(lines)


def format_conclusions(rows) -> str:
    """What the numbers show, in sentences."""
    sentences = [""]
    for kind in dict.fromkeys(row.kind for row in rows):
        own = {(row.model, row.count): row for row in rows if row.kind == kind}
        sentences += [f"{kind}:", *_against_time(own), *_where_time_wins(own)]
        sentences += _against_residual(own)
        sentences += [*_against_separable(own), *_across_counts(own), *_floors(own)]
    sentences.append(
        "For K >= 3 directions span space wherever they point, so V w with free "
        "weights reaches every displacement: there the basis restricts nothing."
    )
    return "\n".join(sentences)


def _mean(row, held_out=False):
    return float(np.mean(row.held_out if held_out else row.learned))


def _against_time(own):
    for count in (2, 4):
        pair = own.get(("moving basis", count)), own.get(("time basis", count))
        if None in pair:
            continue
        learned, held = (_mean(pair[0], h) / _mean(pair[1], h) for h in (False, True))
        verdict = "shows" if learned <= TIME_GATE else "DOES NOT SHOW"
        yield (
            f"  K={count}: the moving basis has {learned:.2f} of the time basis' error "
            f"({held:.2f} held out). Its claim to at most {TIME_GATE:g} {verdict}."
        )


def _where_time_wins(own):
    wins = [
        count
        for (model, count), row in own.items()
        if model == "time basis"
        and ("moving basis", count) in own
        and _mean(row, True) < _mean(own["moving basis", count], True)
    ]
    if wins:
        yield (
            "  The time basis is the better one, on held-out times, at K="
            f"{', '.join(map(str, wins))}."
        )


def _against_residual(own):
    residual = own.get(("residual", None))
    moving = {k: row for (model, k), row in own.items() if model == "moving basis"}
    if residual is None or not moving:
        return
    count = 8 if 8 in moving else max(moving)
    learned, held = (
        _mean(residual, h) / _mean(moving[count], h) for h in (False, True)
    )
    what = (
        "the basis is not what helps"
        if learned <= RESIDUAL_GATE and held <= RESIDUAL_GATE
        else "the basis helps"
    )
    yield (
        f"  Without a basis (residual): {learned:.2f} of the moving basis' error at "
        f"K={count} ({held:.2f} held out): {what}."
    )


def _against_separable(own):
    for (model, count), row in own.items():
        other = own.get(("moving basis", count))
        if model == "separable" and other is not None and count >= 8:
            ratio = _mean(row, True) / _mean(other, True)
            yield (
                f"  K={count}: weights shared by all points (separable) leave "
                f"{ratio:.2f} of the moving basis' held-out error: weights that follow "
                f"the point {'cost more than they bring' if ratio < 1 else 'help'}."
            )


def _across_counts(own):
    errors = {
        k: _mean(row, True)
        for (model, k), row in own.items()
        if model == "moving basis"
    }
    spread = {k: e for k, e in errors.items() if k >= 3}
    if len(spread) > 1:
        best = min(spread, key=spread.get)
        yield (
            f"  From K=3 on the moving basis' held-out error varies by a factor of "
            f"{max(spread.values()) / min(spread.values()):.2f}; best at K={best}."
        )


def _floors(own):
    for name in ("time basis", "separable"):
        above = [
            np.mean(row.learned) / np.mean(row.floor)
            for (model, _), row in own.items()
            # below a thousandth the fit, not the rank, is what limits
            if model == name and row.floor and np.mean(row.floor) > 1e-3
        ]
        if above:
            yield (
                f"  {name}: fits end {min(above):.2f} to {max(above):.2f} times "
                "the error that its rank allows."
            )


def record(args, rows) -> dict[str, Any]:
    """What is kept of the study."""
    return {
        "settings": asked.without_places(args),
        "machine": clock.machine(),
        "rows": [row._asdict() for row in rows],
        "said": format_conclusions(rows).strip().split("\n"),
    }


def write(out, record, rows) -> None:
    """motion_rank.json and motion_rank.png in a folder."""
    write_json(out / "motion_rank.json", record)
    draw_figure(rows, out / "motion_rank.png")
    console.say(out / "motion_rank.png")


def page(stored) -> str:
    """The page in docs/results below the docstring, from a motion_rank.json."""
    heads = ("tracks", "model", "K", "learned", "held out", "floor", "CPU s")
    rows = [
        [
            row["kind"],
            row["model"],
            "" if row["count"] is None else str(row["count"]),
            *(markdown.over_seeds(row[name], 4) for name in ("learned", "held_out")),
            markdown.number(np.mean(row["floor"]), 4) if row["floor"] else "",
            markdown.number(row["seconds"], 2),
        ]
        for row in stored["rows"]
    ]
    said = markdown.outline(stored["said"])
    return f"{markdown.table(heads, rows, words=2)}\n\n{said}"


def draw_figure(rows, path) -> None:
    """Error against K for each kind of tracks, learned above and held out below."""
    kinds = list(dict.fromkeys(row.kind for row in rows))
    size = (3.6 * len(kinds) + 2, 6.4)
    figure = figures.new_figure(figsize=size, dpi=120, layout="constrained")
    axes = figure.subplots(2, len(kinds), squeeze=False, sharey=True)
    counts = sorted({row.count for row in rows if row.count is not None})
    for line, part in zip(axes, ("learned", "held_out"), strict=True):
        for panel, kind in zip(line, kinds, strict=True):
            _draw_panel(panel, [row for row in rows if row.kind == kind], part)
            panel.set_title(f"{kind}, {part.replace('_', ' ')} times", fontsize=10)
            panel.set_xticks(counts, [str(count) for count in counts])
            panel.set_xlabel("basis vectors K")
        line[0].set_ylabel("RMS error / RMS displacement")
    # A floor may be rounding alone, which would flatten everything above it.
    errors = [e for row in rows for e in (*row.learned, *row.held_out)]
    axes[0, 0].set_ylim(min(errors) / 2, 1.5 * max(errors))
    axes[0, -1].legend(
        frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    with replaced_file(path) as partial:
        figure.savefig(partial)


def _draw_panel(panel, rows, part):
    panel.set_xscale("log", base=2)
    panel.set_yscale("log")
    panel.minorticks_off()
    for model, color in COLORS.items():
        own = [row for row in rows if row.model == model]
        error = np.array([getattr(row, part) for row in own])
        if model == "residual":
            for row in own:
                level = np.mean(getattr(row, part))
                panel.axhline(level, color=color, label="residual, no basis")
            continue
        counts = [row.count for row in own]
        panel.plot(counts, error.mean(axis=1), "-o", color=color, ms=4, label=model)
        panel.fill_between(
            counts, error.min(axis=1), error.max(axis=1), color=color, alpha=0.15
        )
        if part == "learned" and own and own[0].floor:
            floor = [np.mean(row.floor) for row in own]
            panel.plot(counts, floor, ":", color=color, label=f"{model}: floor")
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
