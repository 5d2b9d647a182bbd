"""Render a built-in dynamic scene as a Nerfies directory, with its ground truth.

nerfies make_scene OUT [--preset NAME] [--frames N] [--set path=value]
"""

import dataclasses
import pathlib
import shlex
from typing import Literal

from experiments import cli
from nerfies_jax.runs import platform
from nerfies_jax.runtime import console
from nerfies_jax.training import specs


@dataclasses.dataclass(frozen=True)
class MakeScene:
    """Render a built-in dynamic scene as a Nerfies directory.

    `truth.npz` in it holds flow, point tracks, thing ids and transient masks.
    """

    out: cli.Positional[pathlib.Path]
    """Folder to write. It must be empty or missing."""
    preset: cli.Scene = "default"
    """Scene to render."""
    frames: int | None = None
    """Number of timestamps (default: the preset's)."""
    size: tuple[int, int] | None = None
    """Width and height in pixels (default: the preset's)."""
    seed: int = 0
    """Seed of the camera path, the exposure and the points, but not of the objects."""
    set: cli.Overrides = ()
    """Any other setting of the scene, as path.to.field=value."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to trace rays on."""


@cli.command(MakeScene)
def main(args):
    """Render and write the scene. Wrong input ends with exit code 2."""
    with cli.user_errors():
        platform.start_jax(args.device)
        from nerfies_jax.capture import synthetic

        sizes = {"frames": args.frames, "size": args.size}
        sizes = {name: value for name, value in sizes.items() if value is not None}
        spec = dataclasses.replace(synthetic.PRESETS[args.preset], **sizes)
        spec = specs.override(spec, args.set)
        synthetic.write(spec, args.out, args.seed)
    width, height = spec.size
    console.say(
        f"{args.out}: {spec.name}, {spec.frames} frame times at {width}x{height}, "
        f"ground truth in {args.out / synthetic.TRUTH_FILE}\n"
        f"next: nerfies reconstruct {shlex.quote(str(args.out))}"
    )
    return {"folder": str(args.out), "scene": specs.as_json(spec), "seed": args.seed}


if __name__ == "__main__":
    main()
