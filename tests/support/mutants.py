"""Change one operation of a source file at a time, as a mistake would.

A mutant is the text of the file with one replacement.  Docstrings, annotations, the
messages of errors and the constants of types are left alone: no test can see them.

Two names are neighbours if they are parameters or fields of one type that follow each
other, or stand next to each other on the left of an assignment.
"""

import ast
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple


class Mutant(NamedTuple):
    """One replacement in a source text, at bytes ``start`` to ``end`` of it."""

    operator: str
    line: int
    function: str
    start: int
    end: int
    text: str

    def applied(self, source: str) -> str:
        """Return the source with the mistake in it."""
        raw = source.encode()
        return (raw[: self.start] + self.text.encode() + raw[self.end :]).decode()

    def described(self, source: str) -> str:
        """Return what stood there, and what stands there now."""
        before = source.encode()[self.start : self.end].decode()
        return f"{' '.join(before.split())}  →  {' '.join(self.text.split())}"


BINARY = {
    ast.Add: ("plus → minus", "-"),
    ast.Sub: ("minus → plus", "+"),
    ast.Mult: ("times → over", "/"),
    ast.Div: ("over → times", "*"),
    ast.FloorDiv: ("floor division → times", "*"),
    ast.Mod: ("modulo → plus", "+"),
    ast.Pow: ("power → times", "*"),
    ast.BitAnd: ("and → or", "|"),
    ast.BitOr: ("or → and", "&"),
}
AT_EQUALITY = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
COMPARED = {
    ast.Lt: ("< → >=", ">="),
    ast.LtE: ("<= → >", ">"),
    ast.Gt: ("> → <=", "<="),
    ast.GtE: (">= → <", "<"),
    ast.Eq: ("== → !=", "!="),
    ast.NotEq: ("!= → ==", "=="),
    ast.Is: ("is → is not", "is not"),
    ast.IsNot: ("is not → is", "is"),
    ast.In: ("in → not in", "not in"),
    ast.NotIn: ("not in → in", "in"),
}
SWAPPED = {
    "sin": "cos",
    "cos": "sin",
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmin": "argmax",
    "argmax": "argmin",
    "all": "any",
    "any": "all",
    "mean": "sum",
    "ppf": "cdf",
}
DROPPED = ("wrap_angle", "wrapped", "sqrt", "abs", "square", "log", "exp")
COPIED = ("copy", "deepcopy")
SYMMETRIC = ("min", "max", "minimum", "maximum", "hypot", "allclose", "isinstance")
INDICES = ("i", "j", "k", "t", "begin", "end", "step", "run", "row", "slot", "index")
UNSEEN = ("dtype", "order", "copy", "title", "label")

Change = tuple[str, int, int, str]


def mutants_of(source: str) -> list[Mutant]:
    """Return every mutant of a source text, in the order of its lines."""
    return sorted(_Search(source).found(), key=lambda m: (m.start, m.operator))


class _Search:
    """The search through one file."""

    def __init__(self, source: str) -> None:
        self.raw = source.encode()
        starts, total = [], 0
        for line in self.raw.splitlines(keepends=True):
            starts.append(total)
            total += len(line)
        self.starts = starts
        self.tree = ast.parse(source)
        self.fields = _beside(
            (field.target.id, ast.unparse(field.annotation))
            for part in ast.walk(self.tree)
            if isinstance(part, ast.ClassDef)
            for field in part.body
            if isinstance(field, ast.AnnAssign)
        )
        self.names: dict[str, str] = {}

    def found(self) -> Iterator[Mutant]:
        """Yield the mutants of constants of the module and of all functions."""
        yield from self._inside(self.tree, "")

    def _inside(self, node: ast.AST, function: str) -> Iterator[Mutant]:
        for child in ast.iter_child_nodes(node):
            if _is_unseen(child):
                continue
            name, names = function, self.names
            if isinstance(child, ast.FunctionDef):
                name, self.names = child.name, _names_beside(child)
            for operator, start, end, text in self._changes(child):
                yield Mutant(operator, child.lineno, name, start, end, text)
            yield from self._inside(child, name)
            self.names = names

    def _changes(self, node: ast.AST) -> Iterator[Change]:
        kind = type(node)
        if kind in CHANGES:
            yield from CHANGES[kind](self, node)

    def span(self, node: ast.AST) -> tuple[int, int]:
        """Return where a node begins and ends in the text."""
        return (
            self.starts[node.lineno - 1] + node.col_offset,
            self.starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def text(self, node: ast.AST) -> str:
        """Return the text of a node."""
        start, end = self.span(node)
        return self.raw[start:end].decode()

    def binary(self, node: ast.BinOp) -> Iterator[Change]:
        """Yield another operation of the same two."""
        if type(node.op) in BINARY and not _is_text(node):
            name, sign = BINARY[type(node.op)]
            # on one line: what follows may rely on its brackets
            yield self._joined(node, node.left, sign, node.right, name)
        is_sum = isinstance(node.op, ast.Add | ast.Sub)
        if is_sum and getattr(node.right, "value", None) == 1:
            yield ("one dropped", *self.span(node), self.text(node.left))

    def augmented(self, node: ast.AugAssign) -> Iterator[Change]:
        """Yield ``-=`` for ``+=``, and the like."""
        if type(node.op) in BINARY:
            name, sign = BINARY[type(node.op)]
            yield self._joined(node, node.target, f"{sign}=", node.value, f"{name} (=)")

    def compared(self, node: ast.Compare) -> Iterator[Change]:
        """Yield the opposite of a comparison, and its neighbour at equality."""
        if len(node.ops) == 1:
            op, right = type(node.ops[0]), node.comparators[0]
            name, sign = COMPARED[op]
            yield self._joined(node, node.left, sign, right, name)
            if op in AT_EQUALITY:
                yield self._joined(node, node.left, AT_EQUALITY[op], right, "equality")

    def boolean(self, node: ast.BoolOp) -> Iterator[Change]:
        """Yield ``or`` for ``and``, and ``and`` for ``or``."""
        sign = "or" if isinstance(node.op, ast.And) else "and"
        parts = f" {sign} ".join(f"({self.text(value)})" for value in node.values)
        yield (f"boolean → {sign}", *self.span(node), f"({parts})")

    def unary(self, node: ast.UnaryOp) -> Iterator[Change]:
        """Yield an operand without its sign, or without ``not`` or ``~``."""
        if not isinstance(node.op, ast.UAdd):
            yield ("sign or not dropped", *self.span(node), self.text(node.operand))

    def constant(self, node: ast.Constant) -> Iterator[Change]:
        """Yield another number."""
        if isinstance(node.value, bool):
            yield ("constant", *self.span(node), str(not node.value))
        elif isinstance(node.value, int):
            other = {0: 1, 1: 0}.get(node.value, node.value + 1)
            yield ("constant", *self.span(node), str(other))
        elif isinstance(node.value, float):
            yield ("constant", *self.span(node), repr(2 * node.value or 1.0))

    def called(self, node: ast.Call) -> Iterator[Change]:
        """Yield another function, only its argument, or two arguments exchanged."""
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in SWAPPED:
            end = self.span(node.func)[1]
            yield ("function swapped", end - len(name), end, SWAPPED[name])
        if name in DROPPED and len(node.args) == 1:
            yield ("function dropped", *self.span(node), f"({self.text(node.args[0])})")
        if name in COPIED:
            copied = node.args[0] if node.args else getattr(node.func, "value", node)
            yield ("copy dropped", *self.span(node), f"({self.text(copied)})")
        for a, b in pairwise(node.args if name not in SYMMETRIC else ()):
            is_alike = type(a) is type(b) and isinstance(a, ast.Name | ast.Attribute)
            if is_alike and self.text(a) != self.text(b):
                first, second = self.span(a), self.span(b)
                between = self.raw[first[1] : second[0]].decode()
                exchanged = f"{self.text(b)}{between}{self.text(a)}"
                yield ("arguments exchanged", first[0], second[1], exchanged)

    def attribute(self, node: ast.Attribute) -> Iterator[Change]:
        """Yield a matrix that is not transposed, or the neighbour of a field."""
        if node.attr == "T":
            yield ("transpose dropped", *self.span(node), self.text(node.value))
        elif isinstance(node.ctx, ast.Load) and node.attr in self.fields:
            end = self.span(node)[1]
            start = end - len(node.attr.encode())
            yield ("neighbour", start, end, self.fields[node.attr])

    def name(self, node: ast.Name) -> Iterator[Change]:
        """Yield the neighbour of a name."""
        if isinstance(node.ctx, ast.Load) and node.id in self.names:
            yield ("neighbour", *self.span(node), self.names[node.id])

    def subscript(self, node: ast.Subscript) -> Iterator[Change]:
        """Yield the entry before."""
        if isinstance(node.slice, ast.Name) and node.slice.id in INDICES:
            yield ("index - 1", *self.span(node.slice), f"{node.slice.id} - 1")

    def slice(self, node: ast.Slice) -> Iterator[Change]:
        """Yield a part that begins or ends one entry later."""
        for bound in (node.lower, node.upper):
            if bound is not None and not isinstance(bound, ast.Constant):
                yield ("bound + 1", *self.span(bound), f"{self.text(bound)} + 1")

    def defined(self, node: ast.FunctionDef) -> Iterator[Change]:
        """Yield other defaults."""
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if isinstance(default, ast.Constant):
                yield from self.constant(default)

    def assigned(self, node: ast.Assign) -> Iterator[Change]:
        """Yield nothing in place of writing an array's entry."""
        if all(isinstance(target, ast.Subscript) for target in node.targets):
            yield ("assignment dropped", *self.span(node), "pass")

    def expression(self, node: ast.Expr) -> Iterator[Change]:
        """Yield nothing in place of a call for its effect."""
        if isinstance(node.value, ast.Call):
            yield ("call dropped", *self.span(node), "pass")

    def _joined(
        self, whole: ast.AST, left: ast.AST, sign: str, right: ast.AST, name: str
    ) -> Change:
        """Replace only what stands between two operands."""
        first, last = self.span(left)[1], self.span(right)[0]
        between = self.raw[first:last].decode()
        closing = between[: len(between) - len(between.lstrip(") \n"))]
        opening = between[len(between.rstrip("( \n")) :]
        assert self.span(whole)[0] <= first < last <= self.span(whole)[1]
        return (name, first, last, f"{closing} {sign} {opening}")


CHANGES = {
    ast.BinOp: _Search.binary,
    ast.AugAssign: _Search.augmented,
    ast.Compare: _Search.compared,
    ast.BoolOp: _Search.boolean,
    ast.UnaryOp: _Search.unary,
    ast.Constant: _Search.constant,
    ast.Call: _Search.called,
    ast.Attribute: _Search.attribute,
    ast.Assign: _Search.assigned,
    ast.Expr: _Search.expression,
    ast.Name: _Search.name,
    ast.Subscript: _Search.subscript,
    ast.Slice: _Search.slice,
    ast.FunctionDef: _Search.defined,
}


def _beside(typed: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return names by their neighbours: the one that follows, else the one before."""
    pairs = [(a, b) for (a, kind), (b, other) in pairwise(typed) if kind == other]
    return {b: a for a, b in pairs} | dict(pairs)


def _names_beside(function: ast.FunctionDef) -> dict[str, str]:
    """Return the neighbours of parameters and of what is assigned together."""
    given = function.args
    typed = [
        (each.arg, ast.unparse(each.annotation))
        for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)
        if each.annotation
    ]
    found = _beside(typed)
    for part in ast.walk(function):
        if isinstance(part, ast.Tuple) and isinstance(part.ctx, ast.Store):
            together = [each.id for each in part.elts if isinstance(each, ast.Name)]
            found |= _beside((name, "") for name in together if name != "_")
    return found


def _is_text(node: ast.BinOp) -> bool:
    """Whether strings are joined, or types of an alias."""
    operands = [node.left, node.right]
    texts = (ast.JoinedStr, ast.Name) if isinstance(node.op, ast.BitOr) else ()
    return any(
        (isinstance(o, ast.Constant) and isinstance(o.value, str | type(None)))
        or isinstance(o, ast.JoinedStr)
        or (texts and isinstance(o, texts) and o.id[:1].isupper())
        for o in operands
    )


def _is_unseen(node: ast.AST) -> bool:
    """Whether a part of the tree has no effect that a test could judge."""
    if isinstance(node, ast.Raise | ast.arguments | ast.JoinedStr | ast.ImportFrom):
        return True
    if isinstance(node, ast.keyword):
        return node.arg in UNSEEN
    if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
        return True
    if isinstance(node, ast.AnnAssign):
        return node.value is None
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
