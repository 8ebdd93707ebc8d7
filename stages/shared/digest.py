"""What code a stage runs: a digest of the syntax trees of every module it imports from this repository.

Snakemake sees a stage only as a shell command; this digest is among the rule's params, so that a changed
function reruns its users, while a comment, a docstring or the layout reruns nothing.
"""

import ast
import functools
import hashlib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def code_digest(module: str) -> str:
    """12 hex digits over `module` (e.g. "stages.flow.estimate") and all `stages.*` modules it imports, at any depth."""
    digest = hashlib.sha256()
    for name in sorted(imported_modules(module)):
        digest.update(name.encode() + _tree(_path(name)).encode())
    return digest.hexdigest()[:12]


def imported_modules(module: str) -> set[str]:
    """`module` and the modules of this repository that it imports, directly or not, also inside functions."""
    found: set[str] = set()
    queue = [module]
    while queue:
        name = queue.pop()
        if name in found or not _path(name).exists():
            continue
        found.add(name)
        queue += _imports(_path(name))
        queue += [name.rpartition(".")[0]] if "." in name else []
    return found


def _path(module: str) -> Path:
    base = ROOT.joinpath(*module.split("."))
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


@functools.cache
def _imports(path: Path) -> list[str]:
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names if alias.name.startswith("stages")]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stages"):
            names += [str(node.module)] + [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@functools.cache
def _tree(path: Path) -> str:
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
            node.body = body[1:]  # type: ignore[attr-defined]
    return ast.dump(tree)
