"""Faults to plant: one change of an operator, a sign, a number or two arguments."""

import ast
import itertools
import pathlib
import random
from typing import NamedTuple

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = ("nerfies_jax", "gaussians_jax")
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


class Fault(NamedTuple):
    """One change of the source: the text from `start` to `end` becomes `text`."""

    path: str
    line: int
    function: int  # line where the innermost function around it begins
    start: int
    end: int
    text: str


def sample_faults(count: int, seed: int, only: str = "") -> list[Fault]:
    """Sample faults, one in each module before any module has two."""
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
    sample: list[Fault] = []
    while by_module and len(sample) < count:
        sample += [faults.pop() for faults in by_module]
        by_module = [faults for faults in by_module if faults]
    return sample[:count]


def places(path: str, source: str) -> list[Fault]:
    """Return all faults that can be planted in the functions of a module."""
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def at(line, column):
        return starts[line - 1] + column

    all_changes = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            marks = [function.lineno] + [d.lineno for d in function.decorator_list]
            for statement in function.body:
                changes = _changes(statement, source.encode(), at)
                all_changes += [(min(marks), *change) for change in changes]
    # Outer functions come first: what stands in an inner one is of that.
    unique = {
        (start, end): (line, first, text)
        for first, line, start, end, text in all_changes
    }
    return [
        Fault(path, line, first, *span, text)
        for span, (line, first, text) in unique.items()
    ]


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
        has_star = any(isinstance(arg, ast.Starred) for arg in (first, second))
        if not has_star and not _in_any_order(node.func):
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
