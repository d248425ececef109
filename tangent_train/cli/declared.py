"""Declared types of settings, read from source code.

Nothing is imported: a command line is understood before torch is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_Found = tuple[str, ast.AST]
"""A definition, and the module that it is in."""


def declared_types(targets: Iterable[str], name: str) -> set[str]:
    """Names of the types that an argument may have, such as ``float`` and ``Path``.

    Args:
        targets: Full names of the classes and functions that take it.
        name: Name of the argument.

    Returns:
        The types for any of them; none if nothing takes it.
    """
    found = (_find(*target.rpartition(".")[::2]) for target in targets)
    return {kind for one in filter(None, found) for kind in _types_of_argument(one, name)}


def _types_of_argument(found: _Found, name: str) -> set[str]:
    module, node = found
    functions = [node] if isinstance(node, ast.FunctionDef) else []
    if isinstance(node, ast.ClassDef):
        functions = [
            n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"
        ]
        for one in node.body:
            if isinstance(one, ast.AnnAssign) and ast.unparse(one.target) == name:
                return set(_types(module, one.annotation))
    for function in functions:
        for argument in (*function.args.args, *function.args.kwonlyargs):
            if argument.arg == name and argument.annotation is not None:
                return set(_types(module, argument.annotation))
    for base in node.bases if isinstance(node, ast.ClassDef) else ():
        named = base.value if isinstance(base, ast.Subscript) else base
        of_base = _find(module, named.id) if isinstance(named, ast.Name) else None
        if of_base is not None and (types := _types_of_argument(of_base, name)):
            return types
    return set()


def _types(module: str, node: ast.AST) -> Iterator[str]:
    """Members of a union, also of one that has a name."""
    if isinstance(node, ast.BinOp):
        yield from _types(module, node.left)
        yield from _types(module, node.right)
    elif isinstance(node, ast.Subscript) and ast.unparse(node.value).rpartition(".")[2] in (
        "Optional",
        "Union",
    ):
        inner = node.slice
        for member in inner.elts if isinstance(inner, ast.Tuple) else (inner,):
            yield from _types(module, member)
    elif isinstance(node, ast.Name):
        named = None if node.id == "Path" else _find(module, node.id)
        if named is None or isinstance(named[1], ast.ClassDef):
            yield node.id
        else:
            yield from _types(*named)


@cache
def _find(module: str, name: str) -> _Found | None:
    """The definition of a name in a module, which may import it."""
    tree = _tree(module)
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return module, node
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return module, node.value
    imports = (one for one in ast.walk(tree) if isinstance(one, ast.ImportFrom) and not one.level)
    for one in imports:  # also under "if TYPE_CHECKING"
        if original := {a.asname or a.name: a.name for a in one.names}.get(name):
            return _find(str(one.module), original)
    return None


@cache
def _tree(module: str) -> ast.Module:
    """The source of a module; none if it has no source."""
    top, *rest = module.split(".")
    # That of a whole package: asking for a module in it would import the package.
    spec = find_spec(top) if top.isidentifier() else None
    folders = (spec and spec.submodule_search_locations) or ()
    files = [Path(folder, *rest) for folder in folders]
    places = [p for file in files for p in (file / "__init__.py", file.with_suffix(".py"))]
    if spec is not None and spec.origin and not rest:
        places.append(Path(spec.origin))
    for place in places:
        if place.suffix == ".py" and place.is_file():
            with suppress(SyntaxError, ValueError):  # reported when it is imported
                return ast.parse(place.read_bytes())
    return ast.Module([], [])
