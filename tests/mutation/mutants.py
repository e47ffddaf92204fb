"""Small faults that can be planted into a Python source file: one token or one statement each."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

EXCHANGED_NAMES = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmin": "argmax",
    "argmax": "argmin",
    "floor": "ceil",
    "ceil": "floor",
    "lower": "upper",
    "upper": "lower",
    "monotonic_ns": "time_ns",
    "time_ns": "monotonic_ns",
    "nanmin": "nanmax",
    "nanmax": "nanmin",
    "sin": "cos",
    "cos": "sin",
}
"""Functions that are called with the same arguments and mean something else."""

SYMMETRIC = {
    "max",
    "min",
    "maximum",
    "minimum",
    "hypot",
    "isclose",
    "allclose",
    "array_equal",
    "gcd",
    "lcm",
}
"""Functions of two arguments whose order does not matter."""

EXCHANGED_COMPARISONS = {
    ast.Lt: (r"<", "<="),
    ast.LtE: (r"<=", "<"),
    ast.Gt: (r">", ">="),
    ast.GtE: (r">=", ">"),
    ast.Eq: (r"==", "!="),
    ast.NotEq: (r"!=", "=="),
    ast.Is: (r"\bis\b", "is not"),
    ast.IsNot: (r"\bis\s+not\b", "is"),
    ast.In: (r"\bin\b", "not in"),
    ast.NotIn: (r"\bnot\s+in\b", "in"),
}

EXCHANGED_OPERATORS = {
    ast.Add: (r"\+", "-"),
    ast.Sub: (r"-", "+"),
    ast.Mult: (r"\*", "/"),
    ast.Div: (r"/", "*"),
    ast.FloorDiv: (r"//", "/"),
    ast.Pow: (r"\*\*", "*"),
    ast.BitAnd: (r"&", "|"),
    ast.BitOr: (r"\|", "&"),
}

EXCHANGED_CONNECTIVES = {ast.And: (r"\band\b", "or"), ast.Or: (r"\bor\b", "and")}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One fault: the bytes from `start` to `end` of a source file are replaced.

    Attributes
    ----------
    kind : what is changed, such as "comparison" or "constant".
    line : first line of the change, from 1.
    start, end : offsets in bytes in the UTF-8 source.
    before, after : text that is replaced, and its replacement.

    """

    kind: str
    line: int
    start: int
    end: int
    before: str
    after: str

    def planted(self, source: bytes) -> bytes:
        """Source with the fault in it."""
        return source[: self.start] + self.after.encode() + source[self.end :]


def mutants_of(source: bytes) -> tuple[Mutant, ...]:
    """Return the faults that can be planted into a source file, in the order of its lines.

    A few do not compile (see `compiles`): an exchange inside a pattern, for example.

    Docstrings, annotations, decorators, f-strings, `__all__` and blocks for type checkers are left
    out: what they change is no behaviour, or has no position of its own in Python 3.11.

    Raises
    ------
    SyntaxError : where the source is not Python.

    """
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    return tuple(sorted(finder.found, key=lambda mutant: (mutant.start, mutant.end, mutant.after)))


def compiles(source: bytes) -> bool:
    """Whether a source file is valid Python:
    a mutant that is not would be noticed by every test.
    """
    try:
        compile(source, "mutant", "exec", dont_inherit=True)
    except (SyntaxError, ValueError):
        return False
    return True


class _Finder(ast.NodeVisitor):
    """Collect the mutants of one file while its tree is walked."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        self.found: list[Mutant] = []
        self._line_starts = [0]
        for line in source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))

    # Positions

    def _start(self, node: ast.expr | ast.stmt) -> int:
        return self._line_starts[node.lineno - 1] + node.col_offset

    def _end(self, node: ast.expr | ast.stmt) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._line_starts[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node: ast.expr | ast.stmt) -> str:
        return self.source[self._start(node) : self._end(node)].decode()

    def _add(self, kind: str, start: int, end: int, after: str) -> None:
        before = self.source[start:end].decode()
        if before == after:
            return
        line = self.source.count(b"\n", 0, start) + 1
        self.found.append(Mutant(kind, line, start, end, before, after))

    def _replace(self, kind: str, node: ast.expr | ast.stmt, after: str) -> None:
        self._add(kind, self._start(node), self._end(node), after)

    def _exchange_between(
        self, kind: str, left: ast.expr, right: ast.expr, pattern: str, after: str
    ) -> None:
        """Replace the operator between two expressions."""
        start = self._end(left)
        between = self.source[start : self._start(right)].decode()
        match = re.search(pattern, between)
        if match is None:
            return
        before_operator = len(between[: match.start()].encode())
        operator = len(match.group().encode())
        self._add(kind, start + before_operator, start + before_operator + operator, after)

    # What is walked, and what is not

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._visit_function(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self._visit_function(node)

    def _visit_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if default is not None:
                self.visit(default)
        for statement in node.body:
            self.visit(statement)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        if "__all__" not in names and "__slots__" not in names:
            self.generic_visit(node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave f-strings alone: Python 3.11 gives no positions in them."""

    def visit_Import(self, node: ast.Import) -> None:
        """Leave imports alone."""

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        """Leave imports alone."""

    # Statements

    def visit_If(self, node: ast.If) -> None:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return
        self._replace("condition", node.test, f"not ({self._text(node.test)})")
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not _is_none(node.value):
            self._replace("return", node, "return None")
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._replace("raise", node, "pass")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call | ast.Await):
            self._replace("call", node, "pass")
        if not isinstance(node.value, ast.Constant):
            self.generic_visit(node)

    def visit_Break(self, node: ast.Break) -> None:
        self._replace("loop", node, "continue")

    def visit_Continue(self, node: ast.Continue) -> None:
        self._replace("loop", node, "break")

    # Expressions

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = (node.left, *node.comparators)
        for left, operator, right in zip(operands, node.ops, operands[1:], strict=False):
            pattern, after = EXCHANGED_COMPARISONS[type(operator)]
            self._exchange_between("comparison", left, right, pattern, after)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if (
            type(node.op) in EXCHANGED_OPERATORS
            and not _is_text(node.left)
            and not _is_text(node.right)
        ):
            pattern, after = EXCHANGED_OPERATORS[type(node.op)]
            self._exchange_between("arithmetic", node.left, node.right, pattern, after)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        pattern, after = EXCHANGED_CONNECTIVES[type(node.op)]
        self._exchange_between("connective", node.values[0], node.values[1], pattern, after)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.Not):
            self._replace("not", node, self._text(node.operand))
        if isinstance(node.op, ast.USub):
            self._replace("sign", node, self._text(node.operand))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool):
            self._replace("constant", node, str(not node.value))
        elif isinstance(node.value, int):
            self._replace("constant", node, str(node.value + 1))
        elif isinstance(node.value, float):
            larger = 1.0 if node.value == 0.0 else node.value * 2.0
            self._replace("constant", node, repr(larger))

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if isinstance(node.slice, ast.Slice):
            if node.slice.lower is not None:
                self._replace("slice", node.slice.lower, "")
            if node.slice.upper is not None:
                self._replace("slice", node.slice.upper, "")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func
        if isinstance(called, ast.Name) and called.id in EXCHANGED_NAMES:
            self._replace("function", called, EXCHANGED_NAMES[called.id])
        if isinstance(called, ast.Attribute) and called.attr in EXCHANGED_NAMES:
            end = self._end(called)
            start = end - len(called.attr.encode())
            self._add("function", start, end, EXCHANGED_NAMES[called.attr])
        self._exchange_arguments(node)
        self.generic_visit(node)

    def _exchange_arguments(self, node: ast.Call) -> None:
        if len(node.args) < 2:
            return
        name = self._text(node.func).rsplit(".", 1)[-1]
        if name in SYMMETRIC:
            return
        first = node.args[0]
        second = node.args[1]
        if isinstance(first, ast.Starred) or isinstance(second, ast.Starred):
            return
        between = self.source[self._end(first) : self._start(second)].decode()
        exchanged = f"{self._text(second)}{between}{self._text(first)}"
        if self._text(first) != self._text(second):
            self._add("arguments", self._start(first), self._end(second), exchanged)

    def generic_visit(self, node: ast.AST) -> None:
        for child in _children(node):
            self.visit(child)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Children of a node without its annotations and decorators."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        values = value if isinstance(value, list) else [value]
        for child in values:
            if isinstance(child, ast.AST):
                yield child


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def _is_text(node: ast.expr) -> bool:
    if isinstance(node, ast.JoinedStr):
        return True
    return isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
