"""Report of a run as an HTML page. Programs should read `metrics.json` instead.

The page is one file without scripts or external resources: images and short videos are
embedded. It contains no absolute paths of the machine that it was written on.
"""

import base64
import html
import io
import json
import math
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import PIL.Image

from nerfies_jax.capture import images
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.metrics.metric_table import GROUPS, METRICS, Entry, main_key
from nerfies_jax.runs import relative_paths
from nerfies_jax.runs.report_style import STYLE
from nerfies_jax.runtime import events

# Larger videos are linked: base64 adds a third, and mail servers reject about 10 MB.
EMBEDDED_VIDEO_BYTES = 6 * 2**20
HEADLINES = (
    "heldout.fitted_psnr",
    "heldout.fitted_ssim",
    "heldout.psnr",
    "heldout.ssim",
    "heldout.moving_psnr",
    "heldout.static_psnr",
    "baseline.neighbor_mean",
    "motion.gain",
    "train.seconds",
    "render.ms_per_frame",
    "file.bytes",
    "gaussians",
    "parameters",
)
# Wider images scroll horizontally on a phone instead of becoming illegible.
WIDE_PX = 1100
_BETTER = {"higher": "\u2191 higher", "lower": "\u2193 lower", "equal": ""}
_OTHER = "Other"  # group of metrics that `metric_table` does not contain


class Figure(NamedTuple):
    """An image file and a caption for it."""

    path: pathlib.Path  # PNG or JPEG
    caption: str  # full sentences
    link: str = ""  # file next to the page that the image links to


class Video(NamedTuple):
    """A video file, a caption for it, and the image that replaces it in print."""

    path: pathlib.Path  # mp4
    caption: str  # full sentences
    poster: np.ndarray  # uint8 [height, width, 3], sRGB


class Command(NamedTuple):
    """A suggested command."""

    purpose: str
    line: str


@events.stage("writing the report")
def write(
    folder: str | pathlib.Path,
    title: str,
    metrics: Sequence[Metric],
    config: Mapping[str, Any],
    figures: Sequence[Figure] = (),
    video: Video | None = None,
    step_ms: Mapping[str, float] | None = None,
    notes: Sequence[str] = (),
    commands: Sequence[Command] = (),
) -> pathlib.Path:
    """Write `report.html`, atomically.

    Args:
      folder: The folder of the run. Absolute paths in the texts become relative to the
        current folder if it contains `folder`, and to `folder` otherwise.
      title: The heading of the page.
      metrics: Metrics of the run. `metric_table` names and explains them.
      config: The settings of the run, in nested mappings.
      figures: Images to show, in order.
      video: A video to show after the images.
      step_ms: Milliseconds of a training step by part.
      notes: Sentences for the reader, such as metrics that could not be computed.
      commands: Suggested next commands, with relative paths as described above.

    Returns:
      The path of the page.

    Raises:
      ValueError: An image is neither PNG nor JPEG, or the page cannot be written.
    """
    folder = pathlib.Path(folder)

    def without_paths(text):
        return relative_paths.in_text(text, folder)

    figures = [each._replace(caption=without_paths(each.caption)) for each in figures]
    heading = _safe(without_paths(title))
    sections = [
        _headlines(metrics),
        _notes(map(without_paths, notes)),
        *(_figure(figure) for figure in figures),
        _video(video, folder),
        _metrics(metrics),
        _step(step_ms or {}),
        _commands(commands, folder),
        _settings(config, relative_paths.base_of(folder)),
    ]
    page = "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{heading}</title>",
            f"<style>\n{STYLE}</style>",
            "</head>",
            "<body>",
            "<main>",
            f"<h1>{heading}</h1>",
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
    """Format a value with its unit.

    Args:
      value: The value.
      unit: Name of the unit.

    Returns:
      The text.
    """
    if not math.isfinite(value):
        return "not available"
    if unit in ("bytes", "B"):
        for name, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
            if abs(value) >= size:
                return f"{value / size:.3g} {name}"
    exact = float(value).is_integer() and abs(value) < 1e15
    number = f"{int(value):,}" if exact else _round(value)
    return f"{number} {unit}".rstrip() if unit not in ("", "1") else number


def _round(value):
    """Format with four digits, or more if the integer part has more."""
    places = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:,.{places}f}" if places <= 6 else f"{value:.3e}"


def _entry(metric):
    """Entry of a metric in the table, or one made from its key if it has none."""
    unknown = Entry(metric.key, _OTHER, metric.unit, metric.direction, "")
    return METRICS.get(metric.key, unknown)


def _headlines(metrics):
    by_key = {metric.key: metric for metric in metrics}

    def name(metric):
        is_main = main_key(metric.key, by_key) == metric.key
        return _entry(metric).name + ("" if is_main else ", without fitting")

    tiles = [
        f'<div title="{_safe(_entry(metric).explanation)}">'
        f"<dt>{_safe(name(metric))}</dt>"
        f"<dd>{_safe(readable(metric.value, metric.unit))}</dd></div>"
        for metric in map(by_key.get, HEADLINES)
        if metric is not None
    ]
    return f'<dl class="headlines">{"".join(tiles)}</dl>' if tiles else ""


def _notes(notes):
    items = "".join(f"<li>{_safe(_sentence(note))}</li>" for note in notes)
    return f'<ul class="notes">{items}</ul>' if items else ""


def _sentence(note):
    """Capitalize a note, unless it begins with a path or a setting."""
    word = note.partition(" ")[0].rstrip(".,:")
    is_name = any(mark in word for mark in "./=_")
    return note if is_name else note[:1].upper() + note[1:]


def _figure(figure):
    path = pathlib.Path(figure.path)
    kind = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}.get(path.suffix.lower())
    if kind is None:
        raise ValueError(
            f"{path}: images of a report must be PNG or JPEG; convert it first"
        )
    width, height = images.read_header(path).size  # errors name the file
    source = f"data:image/{kind};base64,{_encode(path)}"
    caption = _safe(figure.caption)
    shape = f'width="{width}" height="{height}"'
    if width > WIDE_PX:
        # Focusable, so that it can also be scrolled with the keyboard.
        start = f'<div class="wide" tabindex="0" role="group" aria-label="{caption}">'
        image = (
            f'{start}<img class="broad" {shape} alt="{caption}" src="{source}"></div>'
        )
    else:
        image = f'<img {shape} alt="{caption}" src="{source}">'
    if figure.link:
        name = _safe(figure.link)
        image, link = f'<a href="{name}">{image}</a>', f'<a href="{name}">{name}</a>'
        if name in caption:
            caption = caption.replace(name, link, 1)
        else:
            caption = f"{caption} {link}"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _video(video, folder):
    """Show the video on screen, and its first frame with the file name in print."""
    if video is None:
        return ""
    path = pathlib.Path(video.path)
    if path.stat().st_size <= EMBEDDED_VIDEO_BYTES:
        source = f"data:video/mp4;base64,{_encode(path)}"
    else:
        source = pathlib.Path(os.path.relpath(path, folder)).as_posix()
    poster = f"data:image/jpeg;base64,{_jpeg(video.poster)}"
    height, width = video.poster.shape[:2]
    shape = f'width="{width}" height="{height}"'
    caption = _safe(relative_paths.in_text(video.caption, folder))
    return (
        f'<figure><video controls loop muted playsinline {shape} poster="{poster}" '
        f'aria-label="{caption}" src="{_safe(source)}"></video>'
        f'<img class="print" {shape} alt="" src="{poster}">'
        f'<figcaption>{caption}<span class="print"> This is its first frame; the video '
        f"is {_safe(path.name)}.</span></figcaption></figure>"
    )


def _jpeg(image):
    content = io.BytesIO()
    PIL.Image.fromarray(image).save(content, "JPEG", quality=85)
    return base64.b64encode(content.getvalue()).decode("ascii")


def _metrics(metrics):
    """Show all groups in one table, so that their columns are aligned."""
    rows = []
    for group in (*GROUPS, _OTHER):
        members = [metric for metric in metrics if _entry(metric).group == group]
        if members:
            rows.append(
                f'<tr class="group"><th colspan="3" scope="rowgroup">{group}</th></tr>'
            )
        rows += map(_metric_row, members)
    columns = ("metric", "value", "better")
    return _table("Metrics", columns, "".join(rows), kind="metrics")


def _metric_row(metric):
    entry = _entry(metric)
    return (
        f'<tr><th scope="row" title="{_safe(metric.key)}">{_safe(entry.name)}'
        f"<small>{_safe(entry.explanation)}</small></th>"
        f'<td class="number">{_safe(readable(metric.value, metric.unit))}</td>'
        f'<td class="better">{_BETTER[metric.direction]}</td></tr>'
    )


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
    title = f"Time of a training step: {readable(total, 'ms')}"
    return _table(title, ("part", "time", "share"), rows)


def _settings(config, base):
    rows = "".join(
        f'<tr><th scope="row"><code>{_safe(name)}</code></th>'
        f"<td><code>{_safe(value)}</code></td></tr>"
        for name, value in _flat(config, base)
    )
    table = _table("", ("setting", "value"), rows)
    return f"<details><summary>Settings</summary>{table}</details>" if rows else ""


def _flat(config, base, prefix=""):
    """Yield dotted names and values. An empty group has a row of its own."""
    for name, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, base, f"{prefix}{name}.")
        else:
            value = _relative(value, base)
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            yield f"{prefix}{name}", text


def _relative(value, base):
    """Return the value of a setting with absolute paths made relative to the base."""
    if isinstance(value, list | tuple):
        return [_relative(each, base) for each in value]
    if isinstance(value, str | os.PathLike) and os.path.isabs(value):
        return relative_paths.relative(value, base)
    return value


def _commands(commands, folder):
    items = "".join(
        f"<p>{_safe(command.purpose)}</p><pre><code>{_safe(command.line)}</code></pre>"
        for command in commands
    )
    if not items:
        return ""
    path = relative_paths.relative(folder, relative_paths.base_of(folder))
    base = (
        "the folder of this page"
        if path == "."
        else f"the folder that contains <code>{_safe(path)}</code>"
    )
    note = f"<p>Paths on this page are relative to {base}.</p>"
    return f"<section><h2>Next steps</h2>{items}{note}</section>"


def _table(title, columns, rows, kind=""):
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{column}</th>' for column in columns)
    heading = f"<h2>{_safe(title)}</h2>" if title else ""
    shape = f' class="{kind}"' if kind else ""
    return (
        f'{heading}<div class="wide"><table{shape}><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _encode(path):
    return base64.b64encode(path.read_bytes()).decode("ascii")


def _safe(text):
    return html.escape(str(text), quote=True)
