"""What the pictures of a capture say before anything is trained.

    python -m experiments.evidence CAPTURE
    python -m experiments.evidence --scene fast --out runs/fast-evidence
    python -m experiments.evidence --scenes

Prints how much of the pictures can be carried from frame to frame, what moves, the
tracks and their paths in space, the points at rest and the groups of rigid motion;
draws frames with what moves and with tracks. The record is kept where `reconstruct`
finds it. Of built-in scenes, whose truth is known, it says how far off all this is.
`--scenes` measures every built-in scene, and ways to find optical flow.
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
    """Of the built-in scenes."""
    out: pathlib.Path | None = None
    """Folder for tracks.png and evidence.json (default: runs/evidence-CAPTURE)."""

    def __post_init__(self):
        if self.scenes and cli.given(self.source):
            raise ValueError(
                "--scenes measures every built-in scene: name no capture beside it"
            )


@cli.command(EvidenceOptions)
def main(args):
    """Look at what the command line names; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax("cpu")
        from experiments.evidence import report, scenes

        if args.scenes:
            return scenes.measure(args.seed, args.out)
        return report.look(cli.plain(args.source), args.seed, args.out)


if __name__ == "__main__":
    main()
