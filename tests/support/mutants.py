"""Change one operation of a source file at a time, as a mistake would.

A mutant is the text of the file with one replacement.  Docstrings, annotations, the
messages of errors and the constants of types are left alone: no test can see them.
"""

import ast
from collections.abc import Iterator
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
UNSEEN = ("dtype", "order", "copy", "title", "label")


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

    def found(self) -> Iterator[Mutant]:
        """Yield the mutants of constants of the module and of all functions."""
        yield from self._inside(self.tree, "")

    def _inside(self, node: ast.AST, function: str) -> Iterator[Mutant]:
        for child in ast.iter_child_nodes(node):
            if _is_unseen(child):
                continue
            name = function
            if isinstance(child, ast.FunctionDef):
                name = child.name
            for operator, start, end, text in self._changes(child):
                yield Mutant(operator, child.lineno, name, start, end, text)
            yield from self._inside(child, name)

    def _changes(self, node: ast.AST) -> Iterator[tuple[str, int, int, str]]:
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

    def binary(self, node: ast.BinOp) -> Iterator[tuple[str, int, int, str]]:
        """Yield another operation of the same two."""
        if type(node.op) in BINARY and not _is_text(node):
            name, sign = BINARY[type(node.op)]
            # on one line: what follows may rely on its brackets
            yield self._joined(node, node.left, sign, node.right, name)

    def augmented(self, node: ast.AugAssign) -> Iterator[tuple[str, int, int, str]]:
        """Yield ``-=`` for ``+=``, and the like."""
        if type(node.op) in BINARY:
            name, sign = BINARY[type(node.op)]
            yield self._joined(node, node.target, f"{sign}=", node.value, f"{name} (=)")

    def compared(self, node: ast.Compare) -> Iterator[tuple[str, int, int, str]]:
        """Yield the opposite of a comparison, and its neighbour at equality."""
        if len(node.ops) == 1:
            op, right = type(node.ops[0]), node.comparators[0]
            name, sign = COMPARED[op]
            yield self._joined(node, node.left, sign, right, name)

    def boolean(self, node: ast.BoolOp) -> Iterator[tuple[str, int, int, str]]:
        """Yield ``or`` for ``and``, and ``and`` for ``or``."""
        sign = "or" if isinstance(node.op, ast.And) else "and"
        parts = f" {sign} ".join(f"({self.text(value)})" for value in node.values)
        yield (f"boolean → {sign}", *self.span(node), f"({parts})")

    def unary(self, node: ast.UnaryOp) -> Iterator[tuple[str, int, int, str]]:
        """Yield an operand without its sign, or without ``not`` or ``~``."""
        if not isinstance(node.op, ast.UAdd):
            yield ("sign or not dropped", *self.span(node), self.text(node.operand))

    def constant(self, node: ast.Constant) -> Iterator[tuple[str, int, int, str]]:
        """Yield another number."""
        if isinstance(node.value, bool):
            yield ("constant", *self.span(node), str(not node.value))
        elif isinstance(node.value, int):
            other = {0: 1, 1: 0}.get(node.value, node.value + 1)
            yield ("constant", *self.span(node), str(other))
        elif isinstance(node.value, float):
            yield ("constant", *self.span(node), repr(2 * node.value or 1.0))

    def called(self, node: ast.Call) -> Iterator[tuple[str, int, int, str]]:
        """Yield another function, or only its argument."""
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in SWAPPED:
            end = self.span(node.func)[1]
            yield ("function swapped", end - len(name), end, SWAPPED[name])
        if name in DROPPED and len(node.args) == 1:
            yield ("function dropped", *self.span(node), f"({self.text(node.args[0])})")

    def attribute(self, node: ast.Attribute) -> Iterator[tuple[str, int, int, str]]:
        """Yield a matrix that is not transposed."""
        if node.attr == "T":
            yield ("transpose dropped", *self.span(node), self.text(node.value))

    def assigned(self, node: ast.Assign) -> Iterator[tuple[str, int, int, str]]:
        """Yield nothing in place of writing an array's entry."""
        if all(isinstance(target, ast.Subscript) for target in node.targets):
            yield ("assignment dropped", *self.span(node), "pass")

    def expression(self, node: ast.Expr) -> Iterator[tuple[str, int, int, str]]:
        """Yield nothing in place of a call for its effect."""
        if isinstance(node.value, ast.Call):
            yield ("call dropped", *self.span(node), "pass")

    def _joined(
        self, whole: ast.AST, left: ast.AST, sign: str, right: ast.AST, name: str
    ) -> tuple[str, int, int, str]:
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
}


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
