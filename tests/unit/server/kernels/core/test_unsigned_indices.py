"""Test that loops over the points of a block read them with unsigned indices.

LLVM assumes that a signed index may be negative, and then loads the points one by one instead of
eight at a time: a sweep took twice as long (server/DESIGN.md).
"""

import ast
from pathlib import Path

import pytest
from solidcloud.server import kernels

FILES = sorted(Path(kernels.__file__).parent.rglob("*.py"))


def signed_reads(source: str) -> list[int]:
    """Return the lines where a loop over LANES reads `halves` at a sum without U(...)."""
    found, tree = [], ast.parse(source)
    unsigned = {
        ast.unparse(node.targets[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("U(")
    }
    for loop in ast.walk(tree):
        if not isinstance(loop, ast.For) or ast.unparse(loop.iter) != "range(LANES)":
            continue
        for node in ast.walk(loop):
            if (
                isinstance(node, ast.Subscript)
                and isinstance(node.value, ast.Name)
                and node.value.id == "halves"
                and not isinstance(node.slice, ast.Name)
                and not ast.unparse(node.slice).endswith(")")
                and ast.unparse(node.slice).rpartition(" + ")[2] not in unsigned
            ):
                found.append(node.lineno)
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_loops_over_a_block_use_unsigned_indices(path: Path) -> None:
    assert signed_reads(path.read_text()) == []


def test_a_signed_index_is_found() -> None:
    loop = "for j in range(LANES):\n    x = halves[{}]\n"
    assert signed_reads(loop.format("lane_at + j")) == [2]
    assert signed_reads(loop.format("lane_at + 2 * LANES + j")) == [2]
    assert signed_reads(loop.format("at_x + U(j)")) == []
    assert signed_reads(loop.format("i")) == []
