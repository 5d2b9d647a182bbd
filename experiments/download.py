"""Download a published capture, check its SHA-256 and unpack it.

nerfies download                                   list the captures with a name
nerfies download hypernerf-vrig-chicken captures
nerfies download https://HOST/NAME.zip captures --sha256 DIGITS
"""

import dataclasses
import pathlib
import shlex

from experiments import cli
from nerfies_jax.runtime import console


@dataclasses.dataclass(frozen=True)
class Download:
    """Download a published capture (docs/captures.md says where others are)."""

    name: cli.Positional[str | None] = None
    """Name of a capture, or the address of a zip archive (default: list the names)."""
    out: cli.Positional[pathlib.Path | None] = None
    """Folder to make (default: captures/NAME)."""
    sha256: str | None = None
    """SHA-256 that the archive must have."""

    def __post_init__(self):
        digits = self.sha256 or "0" * 64
        if len(digits) != 64 or set(digits.lower()) - set("0123456789abcdef"):
            raise ValueError(f"--sha256 {self.sha256}: expected 64 hexadecimal digits")


@cli.command(Download)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    from nerfies_jax.capture import download

    if args.name is None:
        sources = {name: source._asdict() for name, source in download.SOURCES.items()}
        for name, source in download.SOURCES.items():
            console.say(f"{name:26} {source.paper}, {source.license}")
        return sources
    with cli.user_errors():
        stem = pathlib.PurePosixPath(args.name).name.removesuffix(".zip")
        folder = args.out or pathlib.Path("captures") / stem
        report = download.download(args.name, folder, args.sha256)
    console.say(
        f"{report.folder}: {report.bytes / 1e6:,.1f} MB, SHA-256 {report.sha256}"
    )
    for capture in report.captures:
        console.say(f"next: nerfies reconstruct {shlex.quote(str(capture))}")
    if not report.captures:
        console.warn(f"{report.folder}: no capture of a format that is read in it")
    return report._asdict()


if __name__ == "__main__":
    main()
