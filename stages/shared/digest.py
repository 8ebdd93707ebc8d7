"""A digest of the code that a stage runs: the compiled form of every module that it imports from this repository.

Snakemake sees a stage only as a shell command. This digest is one of the rule's params, so a changed function reruns
the stages that use it, while a change of comments, layout or the words of a docstring reruns nothing.
"""

import ast
import functools
import hashlib
import importlib.util
import marshal
import py_compile
import re
from collections.abc import Iterable
from pathlib import Path
from types import CodeType

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[2]
IMPORT = re.compile(r"^[ \t]*((?:from|import) stages\b[^\n(]*(?:\([^)]*\))?)", re.MULTILINE)


@functools.cache
def code_digest(module: str) -> str:
    """12 hex digits over `module` and all `stages.*` modules it imports, at any depth, with their weights.

    Args:
        module: a stage such as "stages.flow", whose script is its `__main__`, or a module such as "stages.render.view".
    """
    digest, script = hashlib.sha256(), f"{module}.__main__"
    for name in sorted(imported_modules(script if _file(script) else module)):
        digest.update(name.encode() + _instructions(name).encode() + _weights(name))
    return digest.hexdigest()[:12]


def origin(module: str, inputs: Iterable[Path], options: BaseModel) -> str:
    """A digest of what a result depends on: code, options, and the files `inputs`, with those in folders."""
    digest = hashlib.sha256(options.model_dump_json().encode() + code_digest(module).encode())
    for path in inputs:
        for file in sorted(filter(Path.is_file, path.rglob("*"))) if path.is_dir() else [path]:
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def imported_modules(module: str) -> set[str]:
    """`module` and all modules of this repository that it imports, at any depth and also inside functions."""
    found: set[str] = set()
    queue = [module]
    while queue:
        name = queue.pop()
        if name in found or not _file(name):
            continue
        found.add(name)
        queue += _imports(name)
        queue += [name.rpartition(".")[0]] if "." in name else []
    return found


@functools.cache
def _file(module: str) -> Path | None:
    """The file of a module of this repository; None if there is none."""
    base = ROOT.joinpath(*module.split("."))
    return next((file for file in (base / "__init__.py", base.with_suffix(".py")) if file.is_file()), None)


@functools.cache
def _source(module: str) -> bytes:
    file = _file(module)
    assert file is not None
    return file.read_bytes()


def _weights(module: str) -> bytes:
    """What a module has learnt, which lies beside it under its name; empty if it has nothing."""
    file = _file(module)
    assert file is not None
    beside = file.with_suffix(".safetensors")
    return beside.read_bytes() if beside.exists() else b""


@functools.cache
def _imports(module: str) -> list[str]:
    names: list[str] = []
    for node in ast.parse("\n".join(IMPORT.findall(_source(module).decode()))).body:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names if alias.name.startswith("stages")]
        elif isinstance(node, ast.ImportFrom):
            names += [str(node.module)] + [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@functools.cache
def _instructions(module: str) -> str:
    """The compiled form of a module as text, without line numbers, docstrings and assertions."""
    return repr(_content(_compiled(module)))


def _compiled(module: str) -> CodeType:
    """The code of a module, kept where Python keeps compiled files: all modules take a second to compile.

    A kept file begins with the hash of its source (PEP 552). PYTHONDONTWRITEBYTECODE, which is about imports, changes
    nothing here; a folder that cannot be written keeps none.
    """
    source, file = _source(module), _file(module)
    kept = Path(importlib.util.cache_from_source(str(file), optimization=2))
    header = importlib.util.MAGIC_NUMBER + b"\3\0\0\0" + importlib.util.source_hash(source)
    checked = py_compile.PycInvalidationMode.CHECKED_HASH
    try:
        content = kept.read_bytes() if kept.is_file() else b""
        if not content.startswith(header):
            py_compile.compile(str(file), str(kept), doraise=True, optimize=2, invalidation_mode=checked)
            content = kept.read_bytes()
        if content.startswith(header):  # not if another process has just kept another source
            code: CodeType = marshal.loads(content[len(header) :])
            return code
    except (OSError, EOFError, ValueError, TypeError):  # it cannot be written, or the machine stopped while it was
        pass
    return compile(source, "", "exec", optimize=2, dont_inherit=True)


def _content(code: CodeType) -> tuple[object, ...]:
    inner = [_constant(constant) for constant in code.co_consts]
    names = code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    arguments = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    return code.co_code, code.co_exceptiontable, inner, names, arguments


def _constant(constant: object) -> object:
    if isinstance(constant, frozenset):  # its order differs between processes
        return sorted(map(repr, constant))
    return _content(constant) if isinstance(constant, CodeType) else constant
