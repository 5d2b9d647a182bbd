"""List the fields of a preset that `--set` changes: value, default and meaning.

    nerfies settings splats-tracked-small
    nerfies settings nerfies-small --json

A line is an argument of `--set` with the present value. If a field holds one of several
kinds of settings, or none, the kinds are named: `--set strategy=MCMCStrategySpec`.
"""

import dataclasses
import inspect
import textwrap
from typing import Any

from experiments import cli
from nerfies_jax.runs import platform, representations
from nerfies_jax.runtime import console

WIDTH, COLUMN = 88, 40  # of the page, and of the text next to a field


@dataclasses.dataclass(frozen=True)
class Settings:
    """List the fields of a preset that --set can change."""

    preset: cli.Positional[cli.Preset]
    """Preset, as for nerfies reconstruct."""


@cli.command(Settings)
def main(args):
    """Print the fields. An unknown preset ends with exit code 2."""
    with cli.user_errors():
        platform.start_jax("cpu")
        kind = representations.of_preset(args.preset)
    description = _describe_preset(kind, args.preset)
    console.say("\n".join(lines(description)))
    return description


def _describe_preset(kind: Any, preset: str) -> dict[str, Any]:
    """Describe the source of a preset and, by path, each field."""
    from nerfies_jax.training import spec_fields

    spec = kind.presets[preset]
    fields = {}
    for field in spec_fields.fields_of(spec):
        # One that always holds the same kind of settings is changed by their fields.
        if field.kind == field.value and field.kind[0].isupper():
            continue
        fields[field.path] = {
            "value": field.value,
            "default": field.default,
            "kind": field.kind,
            "about": field.about,
            "source": _place(field.holder),
            "of": _first_line(field.holder),
        }
    return {"preset": preset, "source": _place(type(spec)), "fields": fields}


def lines(description: dict[str, Any]) -> list[str]:
    """Format fields under the settings that have them."""
    groups: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
    for path, field in description["fields"].items():
        above = path.rpartition(".")[0]
        groups.setdefault((above, field["source"]), []).append((path, field))
    text = [f"{description['preset']}, as --set takes it:"]
    for (above, source), fields in groups.items():
        title = f"{above or 'the scene'}: {fields[0][1]['of']}"
        text += ["", *textwrap.wrap(title, WIDTH), f"({source})"]
        for path, field in fields:
            text += _entry(f"{path}={field['value']}", field)
    return text


def _entry(assignment, field):
    """Format an assignment with the kind and meaning of its field next to it."""
    facts = [field["kind"]]
    if field["default"] not in ("", field["value"]):
        facts.append(f"default {field['default']}")
    words = ", ".join(facts) + (f"; {field['about']}" if field["about"] else "")
    notes = textwrap.wrap(words, WIDTH - COLUMN)
    if len(assignment) + 4 > COLUMN:
        notes.insert(0, "")
    heads = [f"  {assignment}", *[""] * (len(notes) - 1)]
    return [
        f"{head:{COLUMN}}{text}".rstrip()
        for head, text in zip(heads, notes, strict=True)
    ]


def _place(kind):
    return f"{kind.__module__}.{kind.__qualname__}"


def _first_line(kind):
    return inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0].replace("\n", " ")


if __name__ == "__main__":
    main()
