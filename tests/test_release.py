"""What the publish workflow makes of a checkout, before it builds."""

import importlib.util
import pathlib
import re
import shutil
import tomllib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("release", ROOT / ".ci/release.py")
release = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(release)
REPOSITORY = "https://example.org/owner/name"


def test_a_release_has_no_relative_links_and_names_its_addresses(tmp_path):
    files = ("README.md", "pyproject.toml", "CHANGELOG.md")
    for name in (*files, "nerfies_jax/runtime/version.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    version = release.version_of(ROOT)
    with pytest.raises(SystemExit, match=rf"not of version {re.escape(version)}"):
        release.main(REPOSITORY, "v9.9.9", tmp_path)
    release.main(f"{REPOSITORY}/", f"v{version}", tmp_path)
    before, page = (
        (ROOT / "README.md").read_text(),
        (tmp_path / "README.md").read_text(),
    )
    targets = re.findall(r"\]\(([^)#]+)[^)]*\)", page)
    assert all("://" in target for target in targets)
    assert len(targets) == len(re.findall(r"\]\(([^)#]+)[^)]*\)", before))
    for target in targets:  # each that was relative leads to a file at the tag
        _, inside, path = target.partition(f"/v{version}/")
        if target.startswith(REPOSITORY):
            assert inside
            assert (ROOT / path).exists(), target
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]
    assert {"Homepage", "Documentation", "Issues"} <= project["urls"].keys()
    assert all(url.startswith(REPOSITORY) for url in project["urls"].values())
    assert "###" in (tmp_path / "build/notes.md").read_text()


def test_requirements_name_only_machines_that_have_wheels():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    # pycolmap has no wheels for Linux ARM, where `all` must install without it.
    assert all("platform_machine" in line for line in extras["sfm"])
    # One that is loaded without its extra would end a command there.
    assert not any("pycolmap" in line for line in project["dependencies"])


def test_the_constraints_name_every_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    names = ("sfm", "video", "report", "view", "spz", "heic", "docs")
    wanted = [*project["dependencies"], *(x for name in names for x in extras[name])]
    wanted = {re.match(r"[\w.-]+", line)[0].lower() for line in wanted}
    lines = (ROOT / "constraints.txt").read_text().splitlines()[1:]
    listed = {line.partition("==")[0] for line in lines}
    assert {name.replace("_", "-") for name in wanted} - {"nerfies-jax"} <= listed
