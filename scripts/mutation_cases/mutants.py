"""Mutants of one kernel file in a seeded random order.

They are those of cosmic-ray's operators, except the ones without effect.
"""

import ast
import random
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

Position = tuple[int, int]  # line from 1, column from 0

# Excluded operators: changes of nothing; removed decorators, which do nothing interpreted; and `is`
# for another comparison, because compiled code has no identity of numbers.
LEFT_OUT = ("NoOp", "RemoveDecorator")
IDENTITY = ("_Is", "_IsNot")


class Mutant(NamedTuple):
    """One change.

    operator, occurrence: cosmic-ray's.
    line: where it begins, from 1.
    function: the innermost function that contains it, "" outside.
    was, now: the changed lines, joined where there are more.
    """

    operator: str
    occurrence: int
    line: int
    function: str
    was: str
    now: str

    @property
    def key(self) -> str:
        """Return the name of the mutant, unique within one source."""
        return f"{self.operator}:{self.occurrence}"


def operators() -> dict[str, type]:
    """Return name -> operator, for those that need no arguments and are not excluded."""
    found = {}
    for name in cosmic_ray.plugins.operator_names():
        operator = cosmic_ray.plugins.get_operator(name)
        short = name.split("/")[-1]
        identity = any(f"{name}_" in f"{short}_" for name in IDENTITY)
        if not operator.arguments() and short not in LEFT_OUT and not identity:
            found[short] = operator
    return found


def spans_left_out(source: str) -> list[tuple[Position, Position]]:
    """Return begin and end of every part of a source where no mutant may begin.

    These are annotations, NamedTuple classes, decorators and strings: no kernel computes with them.
    """
    spans: list[ast.AST] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.AnnAssign):
            spans.append(node.annotation)
        elif isinstance(node, ast.ClassDef):
            if any(isinstance(base, ast.Name) and base.id == "NamedTuple" for base in node.bases):
                spans.append(node)
        elif isinstance(node, ast.FunctionDef):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            spans += [a.annotation for a in arguments if a.annotation is not None]
            spans += [*node.decorator_list, *([node.returns] if node.returns else [])]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            spans.append(node)
    return [((s.lineno, s.col_offset), (s.end_lineno, s.end_col_offset)) for s in spans]  # type: ignore[attr-defined]


def functions(source: str) -> list[tuple[int, int, str]]:
    """Return first line, last line and name of every function."""
    found = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    return [(n.lineno, n.end_lineno or n.lineno, n.name) for n in found]


def mutated(source: str, operator: str, occurrence: int) -> str | None:
    """Return the source with one change; None where that does not parse or is the same code."""
    kind = cosmic_ray.plugins.get_operator(f"core/{operator}")
    changed = mutate_code(source, kind(), occurrence)
    if changed is None:
        return None
    try:
        tree = ast.parse(changed)
    except SyntaxError:
        return None
    return changed if ast.dump(tree) != ast.dump(ast.parse(source)) else None


def changed_lines(source: str, changed: str) -> tuple[str, str]:
    """Return the differing lines as whole lines without indentation."""
    before, after = source.splitlines(), changed.splitlines()
    head = 0
    while head < min(len(before), len(after)) and before[head] == after[head]:
        head += 1
    tail = 0
    while tail < min(len(before), len(after)) - head and before[-1 - tail] == after[-1 - tail]:
        tail += 1
    own = (before[head : len(before) - tail], after[head : len(after) - tail])
    was, now = (" ".join(" ".join(line.split()) for line in lines) for lines in own)
    return was, now


def all_positions(source: str) -> list[list[tuple[str, int, Position]]]:
    """Return (operator, occurrence, begin) of every change, grouped by place, in source order."""
    nodes, spans = list(ast_nodes(get_ast(source))), spans_left_out(source)
    places: dict[tuple[Position, Position, str], list[tuple[str, int, Position]]] = defaultdict(list)
    for name, kind in operators().items():
        operator, occurrence = kind(), -1
        for node in nodes:
            for begin, end in operator.mutation_positions(node):
                occurrence += 1
                if not any(low <= begin < high for low, high in spans):
                    # A comparison and its `not` share a place but are two separate changes.
                    places[begin, end, name.split("_")[0]].append((name, occurrence, begin))
    return [places[key] for key in sorted(places)]


def draw(path: Path, source: str, seed: int) -> Iterator[tuple[Mutant, str]]:
    """Yield every mutant of a file with its source, in a random order.

    The seed, the name and the source determine the order. All places come once, each with one of
    its changes, before any comes twice. Otherwise a `*`, which eleven other operators can replace,
    would weigh eleven times as much as an `and`.
    """
    random_order = random.Random(f"{seed}:{path.as_posix()}")
    places = all_positions(source)
    for place in places:
        random_order.shuffle(place)
    named = functions(source)
    for turn in range(max(map(len, places), default=0)):
        these = [place[turn] for place in places if len(place) > turn]
        random_order.shuffle(these)
        for operator, occurrence, (line, _) in these:
            changed = mutated(source, operator, occurrence)
            if changed is None:
                continue
            inside = [name for first, last, name in named if first <= line <= last]
            was, now = changed_lines(source, changed)
            yield Mutant(operator, occurrence, line, inside[-1] if inside else "", was, now), changed
