# SPDX-License-Identifier: Apache-2.0
"""The imports of this repository, read from its source without running it."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("msg_adapters", "paul_ros", "training")


@dataclass(frozen=True)
class Import:
    """One module that imports another.

    Attributes:
        source: dotted name of the importing module.
        target: dotted name of the imported module; of a foreign package, the name as written.
        late: whether the import stands in a function.
    """

    source: str
    target: str
    late: bool

    @property
    def package(self) -> str:
        """Top-level package of the target."""
        return self.target.partition(".")[0]


def name_of(file: Path) -> str:
    """Return the dotted module name of a file; a test module is top-level, as pytest imports it."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[1:] if parts[0] == "test" else parts).removesuffix(".__init__")


@functools.cache
def modules() -> dict[str, Path]:
    """Return module name -> file for the packages and the tests."""
    files = [file for folder in (*PACKAGES, "test") for file in sorted((ROOT / folder).rglob("*.py"))]
    return {name_of(file): file for file in files}


@functools.cache
def imports_of(module: str) -> tuple[Import, ...]:
    """Return the imports of one module, without those for type checkers."""
    file = modules()[module]
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    found = _imports(ast.parse(file.read_text(encoding="utf-8")), package, late=False)
    return tuple(Import(module, target, late) for target, late in dict.fromkeys(found))


def imports_in(*folders: str) -> Iterator[Import]:
    """Yield the imports of all modules in these top-level packages."""
    for module in modules():
        if module.partition(".")[0] in folders:
            yield from imports_of(module)


def reached(start: Iterable[str]) -> set[str]:
    """Return all modules, also foreign ones, that are loaded when these are imported."""
    found: set[str] = set()
    waiting = list(start)
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            if module in modules():
                waiting += [use.target for use in imports_of(module) if not use.late]
    return found


def _imports(node: ast.AST, package: str, late: bool) -> Iterator[tuple[str, bool]]:
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.Import):
        yield from ((alias.name, late) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = _absolute(node, package)
        for alias in node.names:
            whole = f"{base}.{alias.name}"
            yield (whole if whole in modules() else base), late
    inside = late or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    for child in ast.iter_child_nodes(node):
        yield from _imports(child, package, inside)


def _absolute(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    parts = package.split(".")
    base = parts[: len(parts) - node.level + 1]
    return ".".join([*base, node.module] if node.module else base)
