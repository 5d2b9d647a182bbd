"""Which tests notice a fault: faults planted at random in both packages, one by one.

    python -m experiments.mutants
    python -m experiments.mutants --count 12 --seed 3 --only gaussians_jax/raster

A copy of the checkout gets one fault at a time (an operator, a sign, a comparison, a
number, two swapped arguments, somewhere in a function body; modules take turns), and
the default tests are run until three fail: those named after the module first, then its
room's, then all others. A fault that nothing notices is shown to the full and slow
tests of the room as well. Most of the library's faults of old were of these kinds.
"""

import ast
import collections
import concurrent.futures
import dataclasses
import itertools
import json
import pathlib
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from experiments import cli, markdown

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("nerfies_jax", "gaussians_jax")
COPIED = (*PACKAGES, "experiments", "tests", "docs", "README.md", "pyproject.toml")
OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
OTHERS = {"minimum": "maximum", "maximum": "minimum", "sin": "cos", "cos": "sin"}
# Where a fault cannot be seen, or would be a fault of words: no place to plant one.
NOT_IN = (ast.Raise, ast.Assert, ast.JoinedStr, ast.arguments, ast.AnnAssign)
CAUGHT_BY = 3
DEFAULT = "not full and not slow"
CORE = ("tests named after the module", "tests of its room", "other default tests")
FULL = "full and slow tests of its room"
HARMLESS, NOBODY = "nothing to notice", "nobody"
# What changes no result, though the source differs: (file, line after the change), why.
SAME: dict[tuple[str, str], str] = {}


@dataclasses.dataclass(frozen=True)
class Mutants:
    """Plant faults and see which tests fail."""

    count: int = 60
    """Faults."""
    seed: int = 0
    """Of their places."""
    only: str = ""
    """Only in files whose path begins so."""
    jobs: int = 2
    """Faults tried at the same time."""
    minutes: float = 10.0
    """After which a run of tests that does not end counts as failed."""
    out: pathlib.Path = pathlib.Path("mutants.json")
    """Where the figures go; what stands there, of the same seed, is gone on with."""

    def __post_init__(self):
        for name in ("count", "jobs"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)} must be at least 1")
        if self.minutes <= 0:
            raise ValueError(f"--minutes {self.minutes} must be above 0")


class Fault(NamedTuple):
    """One change of the source: the text from `start` to `end` becomes `text`."""

    path: str
    line: int
    start: int
    end: int
    text: str


def main(arguments=None):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        args = cli.parse(Mutants, arguments)
        faults = drawn(args.count, args.seed, args.only)
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    rows = _stored(args.out, args.seed)
    left = [fault for fault in faults if not any(_is_row_of(fault, r) for r in rows)]
    copies = queue.SimpleQueue()
    with tempfile.TemporaryDirectory() as folder:
        for job in range(args.jobs):
            copies.put(_copied(pathlib.Path(folder) / str(job)))

        def try_one(fault):
            copy = copies.get()
            try:
                return tried(fault, copy, 60 * args.minutes)
            finally:
                copies.put(copy)

        with concurrent.futures.ThreadPoolExecutor(args.jobs) as workers:
            for row in workers.map(try_one, left):
                rows.append(row)
                print(row["at"], "|", row["after"], "|", row["caught_by"], flush=True)
                stored = {"machine": clock.machine(), "seed": args.seed, "rows": rows}
                write_json(args.out, stored)
    print(page({"rows": rows}))


def _is_row_of(fault, row):
    return row["at"] == f"{fault.path}:{fault.line}" and row["text"] == fault.text


def _stored(path, seed):
    stored = json.loads(path.read_text()) if path.exists() else {}
    return stored["rows"] if stored.get("seed") == seed else []


def _copied(folder):
    folder.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            skipped = shutil.ignore_patterns("__pycache__")
            shutil.copytree(source, folder / name, ignore=skipped)
        else:
            shutil.copy(source, folder / name)
    return folder


def drawn(count: int, seed: int, only: str = "") -> list[Fault]:
    """Faults at random, one in each module before any module has two."""
    chance = random.Random(seed)
    by_module = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            faults = places(name, path.read_text()) if name.startswith(only) else []
            chance.shuffle(faults)
            if faults:
                by_module.append(faults)
    chance.shuffle(by_module)
    found = []
    while by_module and len(found) < count:
        found += [faults.pop() for faults in by_module]
        by_module = [faults for faults in by_module if faults]
    return found[:count]


def places(path: str, source: str) -> list[Fault]:
    """Every fault that can be planted in the function bodies of a module."""
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def at(line, column):
        return starts[line - 1] + column

    found = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in function.body:
                found += _changes(statement, source.encode(), at)
    unique = {(start, end): (line, text) for line, start, end, text in found}
    return [Fault(path, line, *span, text) for span, (line, text) in unique.items()]


def _changes(node, source, at):
    """(line, start, end, text) of the node and what it holds."""
    if isinstance(node, NOT_IN) or _is_text(node):
        return
    for left, operator, right in _pairs(node):
        if type(operator) in OPERATORS:
            old, new = OPERATORS[type(operator)]
            start = at(left.end_lineno, left.end_col_offset)
            end = at(right.lineno, right.col_offset)
            between = source[start:end].decode()
            if between.count(old) == 1:
                yield left.end_lineno, start, end, between.replace(old, new)
    span = _span(node, at) if hasattr(node, "col_offset") else None
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        inner = _span(node.operand, at)
        yield node.lineno, *span, source[slice(*inner)].decode()
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield node.lineno, *span, _other_number(node.value)
    elif isinstance(node, ast.Attribute) and node.attr in OTHERS:
        text = source[slice(*span)].decode()
        new = text.removesuffix(node.attr) + OTHERS[node.attr]
        yield node.lineno, *span, new
    elif isinstance(node, ast.Call) and len(node.args) >= 2:
        first, second = node.args[-2:]
        unpacked = any(isinstance(arg, ast.Starred) for arg in (first, second))
        if not unpacked and not _in_any_order(node.func):
            one, other = _span(first, at), _span(second, at)
            between = source[one[1] : other[0]]
            text = source[slice(*other)] + between + source[slice(*one)]
            yield first.lineno, one[0], other[1], text.decode()
    for child in ast.iter_child_nodes(node):
        yield from _changes(child, source, at)


def _pairs(node):
    if isinstance(node, ast.BinOp):
        return [(node.left, node.op, node.right)]
    if isinstance(node, ast.Compare):
        terms = [node.left, *node.comparators]
        return list(zip(terms, node.ops, terms[1:], strict=False))
    if isinstance(node, ast.BoolOp):
        pairs = itertools.pairwise(node.values)
        return [(left, node.op, right) for left, right in pairs]
    return []


def _in_any_order(function):
    name = getattr(function, "attr", getattr(function, "id", ""))
    return name in ("max", "min", "maximum", "minimum", "hypot", "isinstance")


def _is_text(node):
    value = getattr(node, "value", None)
    is_word = isinstance(node, ast.Constant) and isinstance(value, str)
    return is_word or (isinstance(node, ast.Expr) and isinstance(value, ast.Constant))


def _span(node, at):
    return at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset)


def _other_number(value):
    return repr(value + 1 if isinstance(value, int) else 1.5 * value if value else 1.0)


def tried(fault: Fault, copy: pathlib.Path, seconds: float) -> dict:
    """The fault, the tests that notice it, and how far one had to look."""
    path = copy / fault.path
    right = path.read_bytes()
    wrong = right[: fault.start] + fault.text.encode() + right[fault.end :]
    began = time.monotonic()
    row = {
        "at": f"{fault.path}:{fault.line}",
        "text": fault.text,
        "before": _line(right, fault.line),
        "after": _line(wrong, fault.line),
        "caught_by": [],
        "looked_in": "",
    }
    path.write_bytes(wrong)
    try:
        for name, tests, marks in stages(fault.path, copy):
            row["looked_in"] = name
            if tests:
                row["caught_by"] = _failures(tests, marks, copy, seconds)
            if row["caught_by"]:
                break
    finally:
        path.write_bytes(right)
    return row | {"seconds": round(time.monotonic() - began, 1)}


def _line(source, line):
    return source.decode().splitlines()[line - 1].strip()


def stages(path: str, copy: pathlib.Path) -> list[tuple[str, list[str], str]]:
    """(name, what to run, which marks) in the order in which tests are asked."""
    file = pathlib.Path(path)
    package, room = file.parts[0], file.parts[1]
    if package == "gaussians_jax":
        room = "gaussians"
    stem = file.stem.strip("_")
    named = sorted(str(p) for p in (copy / "tests").rglob(f"test_{stem}*.py"))
    here = copy / "tests" / room
    its_room = [str(here)] if here.is_dir() else []
    return [
        (CORE[0], named, DEFAULT),
        (CORE[1], its_room, DEFAULT),
        (CORE[2], [str(copy / "tests")], DEFAULT),
        (FULL, its_room or named, "full or slow"),
    ]


def _failures(tests, marks, copy, seconds):
    """Names of up to three tests that fail; the run itself, where it does not end."""
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-m", marks, "-rfE"]
    command += [f"--maxfail={CAUGHT_BY}", "-p", "no:cacheprovider", "--tb=no", *tests]
    try:
        ran = subprocess.run(
            command, cwd=copy, capture_output=True, text=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return [f"does not end in {seconds:.0f} s"]
    if ran.returncode in (0, 5):  # all passed, or there was none
        return []
    names = re.findall(r"^(?:FAILED|ERROR) tests/(\S+)", ran.stdout, re.MULTILINE)
    return names or ["the tests cannot be collected"]


def page(stored: dict) -> str:
    """The faults, which tests noticed each, and what became of those none noticed."""
    rows = stored["rows"]
    counts = collections.Counter(_fate(row) for row in rows)
    seen = sum(counts[name] for name in CORE)
    faults = len(rows) - counts[HARMLESS]
    heads = ("file and line", "before", "after", "noticed by")
    table = markdown.table(heads, [_cells(row) for row in rows], words=4)
    fates = markdown.bullets([f"{name}: {count}" for name, count in counts.items()])
    return (
        f"The default tests notice {seen} of {faults} faults "
        f"({100 * seen / max(faults, 1):.0f} %); so many by whom, of all {len(rows)}:"
        f"\n\n{fates}\n\n{table}"
    )


def _fate(row):
    if row["caught_by"]:
        return row["looked_in"]
    return HARMLESS if _key(row) in SAME else NOBODY


def _key(row):
    return row["at"].partition(":")[0], row["after"]


def _cells(row):
    tests = [test.partition("@")[0] for test in row["caught_by"]]
    told = ", ".join(f"`{test}`" for test in tests) or SAME.get(_key(row), NOBODY)
    return [row["at"], f"`{row['before']}`", f"`{row['after']}`", told]


if __name__ == "__main__":
    main()
