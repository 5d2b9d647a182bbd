"""What came of a run, on one page for a person; programs read `metrics.json`.

The page is one file: pictures and short films are inside it, nothing is fetched, no
script runs.
"""

import base64
import html
import json
import math
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from nerfies_jax.capture import images
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.measure.clock import Metric
from nerfies_jax.runs.report_style import STYLE

# A larger film stays beside the page; base64 adds a third, and mail stops near 10 MB.
EMBEDDED_FILM_BYTES = 6 * 2**20
HEADLINES = {
    "heldout.psnr": "PSNR, held out",
    "heldout.ssim": "SSIM, held out",
    "heldout.moving_psnr": "PSNR, what moves",
    "heldout.still_psnr": "PSNR, what stands still",
    "floor.neighbours": "PSNR, mean of the neighbouring frames",
    "motion.worth": "what motion is worth",
    "train.seconds": "training",
    "render.ms_per_frame": "a frame",
    "file.bytes": "the model file",
    "gaussians": "Gaussians",
    "parameters": "parameters",
}
# Broader pictures scroll sideways on a phone instead of shrinking to stamps.
BROAD_PX = 1100
_BETTER = {"higher": "higher", "lower": "lower", "equal": ""}


class Figure(NamedTuple):
    """A picture file and what is to be seen in it."""

    path: pathlib.Path  # PNG or JPEG
    caption: str
    link: str = ""  # a file beside the page that the picture leads to


class Command(NamedTuple):
    """Something to run next."""

    purpose: str
    line: str


def write(
    folder: str | pathlib.Path,
    title: str,
    metrics: Sequence[Metric],
    config: Mapping[str, Any],
    figures: Sequence[Figure] = (),
    film: pathlib.Path | None = None,
    step_ms: Mapping[str, float] | None = None,
    notes: Sequence[str] = (),
    commands: Sequence[Command] = (),
) -> pathlib.Path:
    """`folder/report.html`, written atomically; returns its path.

    `step_ms` says where a training step's time goes, part by part; `notes` what the
    reader should know (what was not computed, and why).
    """
    folder = pathlib.Path(folder)
    sections = [
        _headlines(metrics),
        _notes(notes),
        *(_figure(figure) for figure in figures),
        _film(film, folder),
        _metrics(metrics),
        _step(step_ms or {}),
        _settings(config),
        _commands(commands),
    ]
    page = "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{_safe(title)}</title>",
            f"<style>\n{STYLE}</style>",
            "</head>",
            "<body>",
            "<main>",
            f"<h1>{_safe(title)}</h1>",
            *filter(None, sections),
            "</main>",
            "</body>",
            "</html>",
            "",
        ]
    )
    path = folder / "report.html"
    with replaced_file(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def readable(value: float | int, unit: str) -> str:
    """A value with its unit, as a person would write it."""
    if not math.isfinite(value):
        return "not a number"
    if unit in ("bytes", "B"):
        for name, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
            if abs(value) >= size:
                return f"{value / size:.3g} {name}"
    exact = float(value).is_integer() and abs(value) < 1e15
    number = f"{int(value):,}" if exact else _rounded(value)
    return f"{number} {unit}".rstrip() if unit not in ("", "1") else number


def _rounded(value):
    """Four digits, but never fewer than the whole part has."""
    places = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:,.{places}f}" if places <= 6 else f"{value:.3e}"


def _headlines(metrics):
    tiles = [
        f"<div><dt>{_safe(HEADLINES[metric.key])}</dt>"
        f"<dd>{_safe(readable(metric.value, metric.unit))}</dd></div>"
        for metric in metrics
        if metric.key in HEADLINES
    ]
    return f'<dl class="headlines">{"".join(tiles)}</dl>' if tiles else ""


def _notes(notes):
    items = "".join(f"<li>{_safe(note)}</li>" for note in notes)
    return f'<ul class="notes">{items}</ul>' if items else ""


def _figure(figure):
    path = pathlib.Path(figure.path)
    kind = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}.get(path.suffix.lower())
    if kind is None:
        raise ValueError(f"{path}: a report shows PNG and JPEG; convert it first")
    width, height = images.read_header(path).size  # an error here names the file
    source = f"data:image/{kind};base64,{_encoded(path)}"
    caption = _safe(figure.caption)
    shape = f'width="{width}" height="{height}"'
    if width > BROAD_PX:
        # Focusable, so that the keyboard can scroll it too.
        before = f'<div class="wide" tabindex="0" role="group" aria-label="{caption}">'
        picture = (
            f'{before}<img class="broad" {shape} alt="{caption}" src="{source}"></div>'
        )
    else:
        picture = f'<img {shape} alt="{caption}" src="{source}">'
    if figure.link:
        before = f'<a href="{_safe(figure.link)}">'
        picture, caption = f"{before}{picture}</a>", f"{before}{caption}</a>"
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _film(film, folder):
    if film is None:
        return ""
    film = pathlib.Path(film)
    if film.stat().st_size <= EMBEDDED_FILM_BYTES:
        source = f"data:video/mp4;base64,{_encoded(film)}"
        where = film.name
    else:
        source = pathlib.Path(os.path.relpath(film, folder)).as_posix()
        where = f"{film.name}, beside this page"
    return (
        f'<figure><video controls loop muted playsinline src="{_safe(source)}"></video>'
        f"<figcaption>The scene from a moving camera ({_safe(where)})</figcaption>"
        "</figure>"
    )


def _metrics(metrics):
    rows = "".join(
        f'<tr><th scope="row"><code>{_safe(metric.key)}</code></th>'
        f'<td class="number">{_safe(readable(metric.value, metric.unit))}</td>'
        f"<td>{_BETTER[metric.direction]}</td></tr>"
        for metric in metrics
    )
    return _table("Metrics", ("metric", "value", "better"), rows)


def _step(step_ms):
    total = sum(step_ms.values())
    if not total > 0:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{_safe(part)}</th>'
        f'<td class="number">{_safe(readable(value, "ms"))}</td>'
        f'<td class="bar"><span style="width:{100 * value / total:.1f}%"></span>'
        f"{100 * value / total:.0f} %</td></tr>"
        for part, value in step_ms.items()
    )
    title = f"Where a training step's {readable(total, 'ms')} go"
    return _table(title, ("part", "time", "share"), rows)


def _settings(config):
    rows = "".join(
        f'<tr><th scope="row"><code>{_safe(name)}</code></th>'
        f"<td><code>{_safe(value)}</code></td></tr>"
        for name, value in _flat(config)
    )
    table = _table("", ("setting", "value"), rows)
    return f"<details><summary>Settings</summary>{table}</details>" if rows else ""


def _flat(config, prefix=""):
    """Dotted names and values; an empty group is shown as such."""
    for name, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            yield f"{prefix}{name}", text


def _commands(commands):
    items = "".join(
        f"<p>{_safe(command.purpose)}</p><pre><code>{_safe(command.line)}</code></pre>"
        for command in commands
    )
    return f"<h2>What to run next</h2>{items}" if items else ""


def _table(title, columns, rows):
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{column}</th>' for column in columns)
    heading = f"<h2>{_safe(title)}</h2>" if title else ""
    return (
        f'{heading}<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _encoded(path):
    return base64.b64encode(path.read_bytes()).decode("ascii")


def _safe(text):
    return html.escape(str(text), quote=True)
