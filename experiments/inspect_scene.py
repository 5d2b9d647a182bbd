"""Recommend effects for a capture from its images, before any training.

    nerfies inspect_scene CAPTURE
    nerfies inspect_scene --scene transient
    nerfies inspect_scene CAPTURE --seconds 60

Prints a table of decisions and the commands to continue with, and writes a contact
sheet.
"""

import dataclasses
import pathlib

from experiments import cli
from nerfies_jax.runs import platform
from nerfies_jax.runtime import console


@dataclasses.dataclass(frozen=True)
class InspectScene:
    """Recommend effects for a capture, or for a built-in scene."""

    source: cli.Source = cli.NamedSource()
    seed: int = 0
    """Seed of the built-in scene."""
    full: bool = False
    """Advise presets of the papers' sizes instead of those for a CPU."""
    seconds: float | None = None
    """Seconds of training to advise presets for (default: complete runs)."""
    image: pathlib.Path | None = None
    """Contact sheet, PNG (default: runs/inspect-CAPTURE.png, or the first of
    inspect-CAPTURE-2.png, ... that is free)."""
    findings: pathlib.Path | None = None
    """Write findings and advice to this file as well."""

    def __post_init__(self):
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"--seconds {self.seconds:g}: must be above 0")
        cli.check_out_file(self.image, "--image")
        cli.check_out_file(self.findings, "--findings")


@cli.command(InspectScene)
def main(args):
    """Inspect the capture of the command line. Wrong input ends with exit code 2."""
    with cli.user_errors():
        platform.start_jax("cpu")
        from nerfies_jax import runs
        from nerfies_jax.capture import gate
        from nerfies_jax.capture.capture import describe
        from nerfies_jax.capture.images import write_png
        from nerfies_jax.capture.json_files import write_json
        from nerfies_jax.preprocessing import inspection
        from nerfies_jax.runs import adviser
        from nerfies_jax.runs.platform import CACHE

        source = cli.plain(args.source)
        capture = runs.stored_capture(source, args.seed)
        for line in (*describe(capture), "", *gate.table(capture), ""):
            console.say(line)
        inspection_result = inspection.inspect(capture, CACHE / "evidence")
        advice = adviser.advise_all(inspection_result.findings, args.full, args.seconds)
        for line in report(inspection_result, advice, source, args.seconds):
            console.say(line)
        path = args.image or _free(pathlib.Path("runs"), f"inspect-{_name(capture)}")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, inspection_result.sheet)
        console.say(f"contact sheet: {path}")
        record = _as_json(capture, inspection_result, advice)
        if args.findings is not None:
            write_json(args.findings, record)
            console.say(f"findings: {args.findings}")
    return record


def report(inspection_result, advice, source, seconds=None):
    """Format the table and the commands that follow from it."""
    from nerfies_jax.preprocessing import findings
    from nerfies_jax.runs import commands, prices
    from nerfies_jax.runs.config import RunConfig

    costs = prices.format_prices(inspection_result.findings)
    lines = ["", *findings.table(inspection_result.findings, costs), ""]
    lines += [prices.legend(), ""]
    budget = "" if seconds is None else f" --seconds {seconds:g}"
    for choice in advice:
        lines.append(f"{choice.representation}:")
        config = RunConfig(choice.preset, source, overrides=choice.overrides)
        lines.append(f"  {commands.reconstruct(config)}{budget}")
        lines += [f"  note: {note}" for note in choice.notes]
    lines.append(f"looked for {inspection_result.seconds:.0f} s")
    return lines


def _as_json(capture, inspection_result, advice):
    """The same as plain data."""
    from nerfies_jax.capture import gate
    from nerfies_jax.runs import prices

    return {
        "capture": capture.name,
        "checks": [one._asdict() for one in gate.findings(capture)],
        "findings": [dataclasses.asdict(one) for one in inspection_result.findings],
        "cost per step": prices.as_json(inspection_result.findings),
        "advice": [dataclasses.asdict(one) for one in advice],
        "images downsampled by": inspection_result.factor,
        "seconds": inspection_result.seconds,
    }


def _free(folder, stem):
    """The first of STEM.png, STEM-2.png, ... that is not there."""
    path, number = folder / f"{stem}.png", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}.png"
    return path


def _name(capture):
    return "-".join(capture.name.replace("/", " ").split())


if __name__ == "__main__":
    main()
