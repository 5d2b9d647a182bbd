"""Which effects a capture calls for, with evidence, before anything is trained.

    python -m experiments.inspect_scene CAPTURE
    python -m experiments.inspect_scene --scene transient

Prints a table of decisions and commands to go on with; writes a contact sheet.
"""

import dataclasses
import pathlib

from experiments import settings as run_settings


@dataclasses.dataclass(frozen=True)
class InspectScene:
    """Say which effects a capture calls for; without one, look at a built-in scene."""

    capture: run_settings.Positional[pathlib.Path | None] = None
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF or COLMAP layout."""
    scene: str = "default"
    """Which built-in scene, where no capture is given."""
    seed: int = 0
    """Of the built-in scene."""
    factor: int | None = None
    """Read the pictures at 1/FACTOR of their size."""
    max_side: int | None = None
    """Read the pictures with no side longer than this, in pixels."""
    heldout: str | None = None
    """Which frames are scored, and so not looked at: n, or the name of a split."""
    full: bool = False
    """Advise presets of the papers' sizes instead of those for a CPU."""
    picture: pathlib.Path | None = None
    """Contact sheet, PNG (default: runs/inspect-CAPTURE.png)."""
    json: pathlib.Path | None = None
    """Write findings and advice to this file as well."""


def main(arguments=None):
    """Inspect what the command line names; exit code 2 where its input is wrong."""
    asked = run_settings.parse(InspectScene, arguments)
    with run_settings.user_errors():
        run_settings.start_jax("cpu")
        from experiments import inspect_advice, inspect_job, pictures
        from nerfies_jax.capture.capture import describe
        from nerfies_jax.capture.json_files import write_json

        capture = read(asked)
        for line in describe(capture):
            print(line)
        found = inspect_job.inspect(capture)
        advice = [
            inspect_advice.advise(found.findings, kind, asked.full)
            for kind in (inspect_advice.SPLATS, inspect_advice.FIELDS)
        ]
        for line in report(found, advice, _source(asked)):
            print(line)
        path = asked.picture or pathlib.Path("runs", f"inspect-{_name(capture)}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        pictures.save(found.sheet, path)
        print(f"contact sheet: {path}")
        if asked.json is not None:
            write_json(asked.json, as_json(capture, found, advice))
            print(f"findings: {asked.json}")


def read(asked):
    """The capture as it is stored: distortion is still in it."""
    from experiments import runs

    return runs.stored_capture(
        runs.Choices(
            capture=None if asked.capture is None else str(asked.capture),
            scene=asked.scene,
            preset="",
            steps=None,
            overrides=(),
            factor=asked.factor,
            max_side=asked.max_side,
            heldout=asked.heldout,
            seed=asked.seed,
        )
    )


def report(found, advice, source):
    """Lines for a person: the table, then the commands."""
    from experiments import inspect_findings, inspect_prices

    costs = inspect_prices.told(found.findings)
    lines = ["", *inspect_findings.table(found.findings, costs), ""]
    lines += [inspect_prices.LEGEND, ""]
    for one in advice:
        lines.append(f"{one.representation}:")
        lines.append(f"  python -m experiments.reconstruct {source} {one.arguments()}")
        lines += [f"  note: {note}" for note in one.notes]
    lines.append(f"looked for {found.seconds:.0f} s")
    return lines


def as_json(capture, found, advice):
    """The same as plain data."""
    from experiments import inspect_prices

    return {
        "capture": capture.name,
        "findings": [dataclasses.asdict(one) for one in found.findings],
        "cost per step": inspect_prices.as_json(found.findings),
        "advice": [dataclasses.asdict(one) for one in advice],
        "pictures made smaller by": found.factor,
        "seconds": found.seconds,
    }


def _source(asked):
    return str(asked.capture) if asked.capture else f"--scene {asked.scene}"


def _name(capture):
    return "-".join(capture.name.replace("/", " ").split())


if __name__ == "__main__":
    main()
