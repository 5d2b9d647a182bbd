"""Every command in README and docs is one that its settings accept."""

import importlib
import pathlib
import re
import shlex

import pytest

from experiments import cli, results

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Not the pages of finished studies, whose commands an older revision runs.
PAGES = sorted(
    {*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")}
    - {results.PAGES / f"{name}.md" for name in results.FINISHED}
)
COMMAND = re.compile(
    r"(?:(?<![\w/])|(?<=bin/))nerfies (?!study[`\n])(?:study )?([a-z_]+)([^\n#&;]*)"
)


def commands():
    """Each command once, with the first page that it stands on."""
    first_page = {}
    for page in PAGES:
        plain, *fenced = re.split(r"^```", page.read_text(), flags=re.M)
        prose = "".join([plain, *fenced[1::2]])
        spans = re.findall(r"`([^`]+)`", prose)
        code = [*(" ".join(span.split()) for span in spans), *fenced[::2]]
        comments = re.findall(r"<!--.*?-->", prose)
        for name, words in COMMAND.findall("\n".join([*code, *comments])):
            # "..." stands for more options; numerics.md has commands in comments
            words = words.replace("...", "").replace("-->", "").strip()
            first_page.setdefault((name, words), page.name)
    return [(name, words, page) for (name, words), page in first_page.items()]


class Accepted(Exception):
    """The settings took the command; nothing is run."""


@pytest.mark.parametrize(("name", "words", "page"), commands())
def test_a_command_of_the_docs_parses(name, words, page, monkeypatch, capsys):
    parse = cli.parse

    def only_parse(*words):
        parse(*words)
        raise Accepted

    monkeypatch.setattr(cli, "parse", only_parse)
    folder = (ROOT / "experiments" / name).is_dir()
    module = importlib.import_module(f"experiments.{name}{'.__main__' * folder}")
    if not words:  # a name in a sentence, or a command without options
        assert module.main.settings
        return
    with pytest.raises(Accepted):
        module.main(shlex.split(words))
