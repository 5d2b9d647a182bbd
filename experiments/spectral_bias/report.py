"""Tables, sentences and the figure of `experiments.spectral_bias`."""

from typing import Any

import numpy as np

from experiments import asked, markdown
from nerfies_jax import console
from nerfies_jax.capture.json_files import replaced_file, write_json
from nerfies_jax.evaluation import figures
from nerfies_jax.measure import clock

# The measured expectation of the design: on the 2-D signal at equal parameters the KAN
# of raw coordinates has at most half the error of the best encoded MLP.
GATE = 0.5


def progress(results) -> str:
    """One line for a network that is done."""
    first = results[0]
    return (
        f"{first.signal} {first.network}: rmse {np.mean(first.rmse):.4f} in "
        f"{first.steps} steps, {first.seconds:.2f} s"
    )


def name_of(wave) -> str:
    """Periods along each axis, "3" or "3,-2"."""
    return ",".join(f"{periods:g}" for periods in wave)


def other(row) -> float:
    """RMS error that is in none of the signal's sinusoids, of the signal's RMS."""
    # The sinusoids share the signal's power equally.
    own = np.mean(np.square(row.missing), axis=1)
    return float(np.mean(np.sqrt(np.maximum(np.square(row.rmse) - own, 0))))


def tables(results, waves) -> str:
    """One table for each signal and each kind of equality."""
    blocks = []
    for label, components in waves.items():
        for equality, rows in results.items():
            names = "".join(f"{'k=' + name_of(wave):>9s}" for wave in components)
            lines = [
                f"\n{label}, {equality}: RMS error (mean and deviation over seeds, "
                "of the signal's), missing share of each sinusoid, and the RMS of "
                "what is at other frequencies",
                f"{'network':20s} {'size':>5s} {'rate':>6s} {'steps':>6s} {'s':>6s} "
                f"{'rmse':>16s} {names} {'other':>8s}",
            ]
            for row in rows:
                if row.signal != label:
                    continue
                missing = np.mean(row.missing, axis=0)
                lines.append(
                    f"{row.network:20s} {row.parameters:5d} {row.rate:6g} "
                    f"{row.steps:6d} {row.seconds:6.2f} "
                    f"{markdown.over_seeds(row.rmse, 4):>16s} "
                    + "".join(f"{share:9.4f}" for share in missing)
                    + f" {other(row):8.4f}"
                )
            blocks.append("\n".join(lines))
    return "\n".join(blocks)


def format_conclusions(results) -> str:
    """What the numbers show, in sentences."""
    sentences = [""]
    for equality, rows in results.items():
        for label in dict.fromkeys(row.signal for row in rows):
            error = {
                row.network: float(np.mean(row.rmse))
                for row in rows
                if row.signal == label
            }
            ranked = sorted(error, key=error.get)
            sentences.append(
                f"{label}, {equality}: best is {ranked[0]} ({error[ranked[0]]:.4f}), "
                f"then {ranked[1]} ({error[ranked[1]]:.4f})."
                if len(ranked) > 1
                else f"{label}, {equality}: {ranked[0]} ({error[ranked[0]]:.4f})."
            )
            if "kan" in error:
                sentences += _against_kan(label, equality, error)
    return "\n".join(sentences)


def _against_kan(label, equality, error):
    own = error["kan"]
    for others, words in (
        ([n for n in error if n in ("relu", "softplus")], "raw MLPs"),
        (
            [n for n in error if n in ("relu + encoding", "softplus + encoding")],
            "encoded MLPs",
        ),
        ([n for n in error if n.startswith("sine")], "networks of sines"),
        ([n for n in error if n == "kan + encoding"], "encoded KANs"),
    ):
        if not others:
            continue
        best = min(others, key=error.get)
        ratio = own / error[best]
        verdict = "better" if ratio < 1 else "worse"
        yield (
            f"  The KAN of raw coordinates has {ratio:.2f} of the error of {best}, the "
            f"best of {words}: {verdict}."
        )
    encoded = [
        error[n] for n in ("relu + encoding", "softplus + encoding") if n in error
    ]
    if label == "2-D" and equality == "equal steps" and encoded:
        holds = own <= GATE * min(encoded)
        yield (
            f"  At most {GATE:g} of the best encoded MLP's error on the 2-D signal: "
            f"{'holds' if holds else 'DOES NOT HOLD'}."
        )


def record(args, results, waves) -> dict[str, Any]:
    """What is kept of the study."""
    return {
        "settings": asked.without_places(args),
        "machine": clock.machine(),
        "waves": {label: components.tolist() for label, components in waves.items()},
        "results": {
            equality: [row._asdict() for row in rows]
            for equality, rows in results.items()
        },
        "said": format_conclusions(results).strip().split("\n"),
    }


def write(out, record, results, waves) -> None:
    """spectral_bias.json and spectral_bias.png in a folder."""
    write_json(out / "spectral_bias.json", record)
    draw_figure(results, waves, out / "spectral_bias.png")
    console.say(out / "spectral_bias.png")


def page(stored) -> str:
    """The page in docs/results below the docstring, from a spectral_bias.json."""
    parts = []
    for label, components in stored["waves"].items():
        heads = ("network", "numbers", "rate", "steps", "s", "RMS error")
        heads += tuple(f"k={name_of(wave)}" for wave in components)
        for equality, results in stored["results"].items():
            rows = [
                [
                    row["network"],
                    f"{row['parameters']:,}",
                    markdown.short(row["rate"]),
                    f"{row['steps']:,}",
                    markdown.number(row["seconds"], 2),
                    markdown.over_seeds(row["rmse"], 4),
                    *(markdown.number(x, 4) for x in np.mean(row["missing"], axis=0)),
                ]
                for row in results
                if row["signal"] == label
            ]
            parts += [f"## {label}, {equality}", markdown.table(heads, rows)]
    parts += [
        "Errors are shares of the signal's RMS, means and deviations over the seeds; "
        "under k, what is missing of each sinusoid.",
        markdown.outline(stored["said"]),
    ]
    return "\n\n".join(parts)


def draw_figure(results, waves, path) -> None:
    """What is missing of each sinusoid: color a network, dashes an encoding."""
    size = 6 * len(results) + 1.5, 3.6 * len(waves)
    figure = figures.new_figure(figsize=size, dpi=120, layout="constrained")
    axes = figure.subplots(len(waves), len(results), squeeze=False, sharey="row")
    for line, (label, components) in zip(axes, waves.items(), strict=True):
        for panel, (equality, rows) in zip(line, results.items(), strict=True):
            _draw_panel(panel, [row for row in rows if row.signal == label])
            panel.set_title(f"{label}, {equality}", fontsize=10)
            panel.set_xticks(range(len(components)), [name_of(w) for w in components])
            panel.set_xlabel("periods of the sinusoid over [-1, 1]")
        line[0].set_ylabel("missing share of its amplitude")
    axes[0, -1].legend(
        frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    with replaced_file(path) as partial:
        figure.savefig(partial)


def _draw_panel(panel, rows):
    kinds = list(dict.fromkeys(row.network.split(" ")[0] for row in rows))
    for row in rows:
        kind = row.network.split(" ")[0]
        missing = np.asarray(row.missing)
        panel.plot(
            missing.mean(axis=0),
            color=f"C{kinds.index(kind)}",
            linestyle="--" if "+" in row.network else "-",
            marker="o",
            markersize=3.5,
            label=row.network,
        )
    panel.axhline(1, color="0.7", linewidth=0.8, zorder=0)
    panel.set_yscale("log")
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
