"""The page of `experiments.deformation_cost` in docs/results."""

from experiments import markdown


def page(stored) -> str:
    """Everything below the docstring, from what `--out` wrote."""
    curve = stored["knots"]
    first, *spared = stored["spared"]
    return "\n\n".join(
        [
            "## Time and flops for 10,000 Gaussians",
            _costs(stored["costs"]),
            _capital(first),
            markdown.bullets(spared),
            "## Tables of time knots",
            f"{_capital(curve['name'])}: {curve['gaussians']:,} Gaussians, of which "
            f"{curve['moving']:,} move by up to {curve['size']:.3g} scene units. The "
            f"network takes {curve['exact_cpu_ms']:.2f} ms of one core an instant.",
            _knots(curve),
        ]
    )


def _capital(text):
    return f"{text[0].upper()}{text[1:]}"


def _costs(rows):
    heads = ("", "forward, CPU ms", "and backward", "Mflop", "and backward")
    cells = [
        [
            row["name"],
            *(markdown.short(row[f"{kind}_cpu_ms"]) for kind in ("forward", "both")),
            *(
                markdown.short(None if value is None else value / 1e6)
                for value in (row["forward_flops"], row["both_flops"])
            ),
        ]
        for row in rows
    ]
    return markdown.table(heads, cells)


def _knots(curve):
    heads = ("read", "knots", "RMS", "largest", "PSNR dB", "CPU ms", "speed-up", "MB")
    rows = [
        [
            point["interpolation"],
            str(point["knots"]),
            markdown.short(point["rms"]),
            markdown.short(point["largest"]),
            markdown.number(point["psnr"], 1),
            markdown.number(point["cpu_ms"], 2),
            markdown.number(curve["exact_cpu_ms"] / point["cpu_ms"], 1),
            markdown.number(point["bytes"] / 1e6, 1),
        ]
        for point in curve["points"]
    ]
    return markdown.table(heads, rows) + (
        "\n\nErrors are shares of the farthest that a mean goes; PSNR is against the "
        "picture of the exact motion."
    )
