"""Results of preprocessing a capture: optical flow, tracks, masks, rigid groups.

    python -m experiments.evidence CAPTURE
    python -m experiments.evidence --scene fast --out runs/fast-evidence
    python -m experiments.evidence --scenes

Prints the share of pixels with flow, moving objects, tracks and their 3D paths, static
points and rigid groups. Draws frames with masks and tracks. The result is stored where
`reconstruct` finds it. For built-in scenes, whose ground truth is known, it reports the
errors. `--scenes` measures every built-in scene and several flow methods.
"""

import dataclasses
import pathlib

from experiments import cli
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class EvidenceOptions:
    """Say what the pictures of a capture, or of a built-in scene, tell."""

    source: cli.Source = cli.NamedSource()
    scenes: bool = False
    """Measure all built-in scenes and ways to find flow instead of one capture."""
    seed: int = 0
    """Seed of the built-in scenes."""
    out: pathlib.Path | None = None
    """Folder for tracks.png and evidence.json (default: runs/evidence-CAPTURE)."""

    def __post_init__(self):
        if self.scenes and cli.given(self.source):
            raise ValueError(
                "--scenes measures every built-in scene: name no capture beside it"
            )


@cli.command(EvidenceOptions)
def main(args):
    """Preprocess the capture of the command line. Wrong input ends with exit code 2."""
    with cli.user_errors():
        platform.start_jax("cpu")
        from experiments.evidence import report, scenes

        if args.scenes:
            return scenes.measure(args.seed, args.out)
        return report.look(cli.plain(args.source), args.seed, args.out)


if __name__ == "__main__":
    main()
