"""Count violations of the language rules, and fail if a count is above its bound.

The rules: a docstring begins with an imperative or a noun phrase, its first paragraph
has no semicolons, public functions document their arguments and results (Google style),
all text is in American spelling, and words that the field has another name for do not
come back in code: `image`, `video` and `timestamp`, not picture, film and moment.

    python .ci/language.py            # check
    python .ci/language.py --list     # also list every violation
"""

import ast
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("nerfies_jax", "gaussians_jax", "experiments")
# Percent of the docstrings of each package.
BAD_OPENINGS = dict.fromkeys(PACKAGES, 2.0)
SEMICOLONS = dict.fromkeys(PACKAGES, 3.0)
UNDOCUMENTED = 0  # public functions without Args or Returns
BRITISH = 0  # words
OLD = 0  # words

OPENING = re.compile(r"(What|Which|Whether|How|Of|As|Those)\b")
# Searched in single lower-case words.
SPELLING = re.compile(
    r"colour|neighbour|^(de|re|un)?cent(re|res|red|ring)$|grey|behaviour|favour|learnt"
    r"|^burnt$|^towards$|catalogue|^(milli|centi|kilo)?metres?$"
    r"|(optim(?!istix)|initial|regular|normal|stabil|material|quant|recogn|standard|factor"
    r"|penal|minim|maxim|raster|parametr|discret|organ|summar|visual|synchron|serial"
    r"|general|linear|local|final|character|util|memor|vector)is(e|ing|ation)"
    r"|^analys(ed?|ing)$|(model|label|travel|level|signal|cancel|channel)l(ed|ing)$"
)
# optimistix.minimise, and the former name of Capture.center
ALLOWED = {"minimise", "centre"}

EARLIER_NAMES = "nerfies_jax/runtime/earlier_names.py"
OLD_WORDS = re.compile(r"pictures?|(un)?film(s|ed|ing)?|moments?", re.I)
# Moments of gradients, of distributions and of shapes.
MOMENTS = (
    "experiments/hard_cases/networks.py",
    "gaussians_jax/core/protocols.py",
    "gaussians_jax/io/splatv.py",
    "gaussians_jax/optim/",
    "gaussians_jax/scene/first_state.py",
    "gaussians_jax/scene/growth.py",
    "gaussians_jax/scene/presets.py",
    "gaussians_jax/splatting/blending.py",
    "gaussians_jax/strategy.py",
    "nerfies_jax/metrics/image_quality.py",
    "nerfies_jax/scene/steps.py",
    "nerfies_jax/training/chunk.py",
    "nerfies_jax/training/updates.py",
    "tests/bare_scenes.py",
    "tests/fields/test_scene.py",
    "tests/gaussians/test_densification.py",
    "tests/gaussians/test_lens.py",
    "tests/gaussians/test_mcmc.py",
    "tests/gaussians/test_motion_growth.py",
    "tests/gaussians/test_optimizer.py",
    "tests/gaussians/test_phases.py",
    "tests/test_effect_leaves.py",
    "tests/test_extending.py",
    "tests/training/",
)


def docstrings(path):
    """Yield (line, name, docstring) for a module, its classes and its functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            text = ast.get_docstring(node)
            if text:
                name = getattr(node, "name", path.stem)
                yield getattr(node, "lineno", 1), name, text


def public_functions():
    """Yield (path, function) for all functions that the packages' stubs name."""
    for package in PACKAGES[:2]:
        for node in ast.parse((ROOT / package / "__init__.pyi").read_text()).body:
            if not isinstance(node, ast.ImportFrom):
                continue
            base = ROOT.joinpath(package, *filter(None, (node.module or "").split(".")))
            for alias in node.names:
                module = base / f"{alias.name}.py"
                if module.exists():
                    yield from ((module, f) for f in functions(module))
                elif base.with_suffix(".py").exists():
                    path = base.with_suffix(".py")
                    named = [f for f in functions(path) if f.name == alias.name]
                    yield from ((path, f) for f in named)


def functions(path):
    """Return the public functions that a module defines."""
    body = ast.parse(path.read_text()).body
    return [
        node
        for node in body
        if isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and not any("overload" in ast.unparse(d) for d in node.decorator_list)
    ]


def missing_sections(function):
    """Name the sections that a function's docstring lacks."""
    text = ast.get_docstring(function) or ""
    taken = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    has_result = not (
        isinstance(function.returns, ast.Constant) and function.returns.value is None
    )
    missing = []
    if taken and "\nArgs:" not in text:
        missing.append("Args")
    if has_result and "\nReturns:" not in text and "\nYields:" not in text:
        missing.append("Returns")
    return missing


def tracked(*patterns):
    """Yield (name, text) for all tracked files but this one."""
    listed = subprocess.run(
        ["git", "ls-files", *patterns],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    for name in listed:
        path = ROOT / name
        if path != pathlib.Path(__file__) and path.exists():
            yield name, path.read_text()


def british_words():
    """Yield (place, word) for British spellings in all tracked text files."""
    files = tracked("*.py", "*.pyi", "*.md", "*.js", "*.html", "*.toml")
    for name, text in files:
        text = text.lower()
        for word in set(re.findall("[a-z]+", text)) - ALLOWED:
            if SPELLING.search(word):
                line = text.count("\n", 0, text.index(word)) + 1
                yield f"{name}:{line}", word


def old_words():
    """Yield (place, identifier or word) for `OLD_WORDS` in code and its text."""
    for name, text in tracked("*.py", "*.pyi"):
        if name == EARLIER_NAMES:
            continue
        for number, line in enumerate(text.splitlines(), 1):
            for word in re.findall("[A-Za-z_]+", line):
                parts = re.findall("[A-Z]?[a-z]+|[A-Z]+", word)
                old = [part for part in parts if OLD_WORDS.fullmatch(part)]
                if name.startswith(MOMENTS):
                    old = [part for part in old if "moment" not in part.lower()]
                if old:
                    yield f"{name}:{number}", word


def main():
    """Print the counts and return 1 if any of them is above its bound."""
    listing, failures = "--list" in sys.argv, []

    def report(what, count, bound, unit, places):
        print(f"{what}: {count:.{1 if unit else 0}f}{unit} (at most {bound}{unit})")
        if listing or count > bound:
            print(*(f"  {place}" for place in places), sep="\n")
        if count > bound:
            failures.append(what)

    for package in PACKAGES:
        found = [
            (
                f"{path.relative_to(ROOT)}:{line} {name}: {text.partition(chr(10))[0]}",
                text,
            )
            for path in sorted((ROOT / package).rglob("*.py"))
            for line, name, text in docstrings(path)
        ]
        opening = [place for place, text in found if OPENING.match(text)]
        semicolon = [place for place, text in found if ";" in text.split("\n\n")[0]]
        for what, places, bounds in (
            ("docstrings that begin with a question word", opening, BAD_OPENINGS),
            ("first paragraphs with a semicolon", semicolon, SEMICOLONS),
        ):
            share = 100 * len(places) / len(found)
            report(f"{package}: {what}", share, bounds[package], " %", places)
    undocumented = [
        f"{path.relative_to(ROOT)}:{function.lineno} {function.name}: "
        + " and ".join(missing_sections(function))
        for path, function in public_functions()
        if missing_sections(function)
    ]
    name = "public functions without sections"
    report(name, len(undocumented), UNDOCUMENTED, "", undocumented)
    words = [f"{place} {word}" for place, word in british_words()]
    report("British spellings", len(words), BRITISH, "", words)
    words = [f"{place} {word}" for place, word in old_words()]
    report("pictures, films and moments", len(words), OLD, "", words)
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
