"""Prepare a checkout for a package index, whose pages have no relative links.

    python .ci/release.py https://HOST/OWNER/NAME v0.2.0

Links of README lead to the repository at the tag, and pyproject.toml gets the project's
addresses. The tag must be that of the version, and CHANGELOG.md must have its notes,
which are written to build/notes.md. The publish workflow runs this before it builds.
"""

import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parents[1]
IMAGES = (".png", ".jpg", ".gif", ".webp")


def absolute_links(text, repository, tag):
    """Make the relative links of a page absolute."""

    def absolute(match):
        target = match[1]
        if "://" in target or target.startswith("#"):
            return match[0]
        kind = "raw" if target.endswith(IMAGES) else "blob"
        return f"]({repository}/{kind}/{tag}/{target})"

    return re.sub(r"\]\(([^)\s]+)\)", absolute, text)


def with_addresses(project, repository):
    """Add the project's addresses to pyproject.toml."""
    addresses = {
        "Homepage": repository,
        "Documentation": f"{repository}/tree/main/docs",
        "Issues": f"{repository}/issues",
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
    }
    table = "\n".join(f'{name} = "{address}"' for name, address in addresses.items())
    scripts = "[project.scripts]"
    return project.replace(scripts, f"[project.urls]\n{table}\n\n{scripts}", 1)


def notes(changelog, version):
    """Return the part of the changelog that is about a version."""
    parts = re.split(r"^## \[([^]]+)\].*$", changelog, flags=re.M)
    about = dict(zip(parts[1::2], parts[2::2], strict=True))
    if version not in about:
        raise SystemExit(f"CHANGELOG.md has no notes about {version}: add them")
    return about[version].strip() + "\n"


def version_of(root):
    """Read the version, without importing the package."""
    text = (root / "nerfies_jax/runtime/version.py").read_text()
    return re.search(r'^__version__ = "([^"]+)"$', text, re.M)[1]


def main(repository, tag, root=ROOT):
    """Rewrite README.md and pyproject.toml of a checkout, and write the notes."""
    version = version_of(root)
    if tag != f"v{version}":
        raise SystemExit(f"the tag {tag} is not of version {version}: use v{version}")
    repository = repository.rstrip("/")
    readme, project = root / "README.md", root / "pyproject.toml"
    readme.write_text(absolute_links(readme.read_text(), repository, tag))
    project.write_text(with_addresses(project.read_text(), repository))
    written = root / "build/notes.md"
    written.parent.mkdir(exist_ok=True)
    written.write_text(notes((root / "CHANGELOG.md").read_text(), version))


if __name__ == "__main__":
    main(*sys.argv[1:])
