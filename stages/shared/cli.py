"""Turn a stage's `main` into its command line, from its signature and its options model."""

import argparse
import contextlib
import errno
import faulthandler
import inspect
import os
import sys
import traceback
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Union, get_args, get_origin, get_type_hints

from stages.shared import log
from stages.shared.errors import InputError
from stages.shared.options import Options, validate


@dataclass(frozen=True)
class In:
    """Marks a path parameter of `main` as an input that must exist; a list of them may be empty if it says so."""

    help: str
    may_be_empty: bool = False


@dataclass(frozen=True)
class Out:
    """Marks a path parameter of `main` as an output; its folder is created and must be writable."""

    help: str


@dataclass(frozen=True)
class _PathFlag:
    """A path parameter of `main`: a single path, an optional one, or a list."""

    name: str
    mark: In | Out
    many: bool
    required: bool


def run(main: Callable[..., str | None], argv: Sequence[str] | None = None) -> NoReturn:
    """Parse flags, call `main(paths..., options)`, write the time spent, and exit.

    Path parameters are annotated `Annotated[Path, In("...")]` or `Out("...")`; one parameter may be an
    `Options` model. `main` returns its result in a few words. The time file holds them with the warnings, and the
    terminal shows them from there. Exit codes: 0 done, 2 bad input (one line), 130 interrupted, 1 internal error.

    Args:
        argv: command line without the program's name; None: that of this process.
    """
    stage = _module_name(main).removeprefix("stages.")
    faulthandler.enable(2)  # a crash in compiled code leaves its stack in the log
    flags, model = _signature(main)
    parser = _parser(main, flags, model)
    arguments = vars(parser.parse_args(argv))
    log_file, stats_file = arguments.pop("log"), arguments.pop("stats")
    try:
        log.setup(log_file)
        paths = {flag.name: arguments.pop(flag.name) for flag in flags}
        _check_paths(flags, paths)
        call: dict[str, Any] = dict(paths)
        if model is not None:
            chosen = {name: value for name, value in arguments.items() if value is not None}
            call["options"] = validate(model, chosen, stage)
            log.logger.info("options: %s", call["options"].model_dump_json())
        summary = main(**call)
        log.logger.info("done: %s", summary)
        if stats_file is not None:
            outputs = [paths[flag.name] for flag in flags if isinstance(flag.mark, Out)]
            _write_stats(stats_file, stage, summary, outputs, call.get("options"))
    except BaseException as error:  # the one place where every failure becomes an exit code
        sys.exit(_report_failure(stage, error, log_file))
    sys.exit(0)


def _module_name(main: Callable[..., str | None]) -> str:
    spec = sys.modules[main.__module__].__spec__
    return (spec.name if spec else main.__module__).removesuffix(".__main__")


def _signature(main: Callable[..., str | None]) -> tuple[list[_PathFlag], type[Options] | None]:
    flags, model = [], None
    hints = get_type_hints(main, include_extras=True)
    for name, parameter in inspect.signature(main).parameters.items():
        annotation = hints[name]
        if isinstance(annotation, type) and issubclass(annotation, Options):
            model = annotation
            continue
        kind, mark = get_args(annotation)
        required = parameter.default is inspect.Parameter.empty
        flags.append(_PathFlag(name, mark, get_origin(kind) is list, required))
    return flags, model


class _OneLineParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see --help\n")


def _parser(
    main: Callable[..., str | None], flags: list[_PathFlag], model: type[Options] | None
) -> argparse.ArgumentParser:
    parser = _OneLineParser(
        prog=f"python -m {_module_name(main)}",
        description=inspect.getdoc(main),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    for flag in flags:
        kind = "input" if isinstance(flag.mark, In) else "output"
        parser.add_argument(
            _dashed(flag.name),
            type=Path,
            nargs=("*" if isinstance(flag.mark, In) and flag.mark.may_be_empty else "+") if flag.many else None,
            required=flag.required,
            default=[] if flag.many else None,
            help=f"{kind}: {flag.mark.help}",
        )
    for name, field in (model.model_fields if model else {}).items():
        text = f"{field.description or ''} (default: {field.get_default(call_default_factory=True)})".replace("%", "%%")
        if field.annotation is bool:
            parser.add_argument(_dashed(name), action=argparse.BooleanOptionalAction, default=None, help=text)
        else:
            nargs = "*" if _is_sequence(field.annotation) else None
            parser.add_argument(_dashed(name), nargs=nargs, metavar=name.upper(), help=text)
    parser.add_argument("--log", type=Path, help="file for the log (default: none)")
    parser.add_argument("--stats", type=Path, help="file for cost, result and warnings, as JSON (default: none)")
    return parser


def _dashed(name: str) -> str:
    return "--" + name.replace("_", "-")


def _is_sequence(annotation: Any) -> bool:
    if get_origin(annotation) in (Union, types.UnionType):
        return any(_is_sequence(part) for part in get_args(annotation))
    return get_origin(annotation) in (list, tuple)


def _check_paths(flags: list[_PathFlag], paths: dict[str, Any]) -> None:
    for flag in flags:
        value = paths[flag.name]
        for path in value if isinstance(value, list) else [value] if value else []:
            if isinstance(flag.mark, In) and not path.exists():
                raise InputError(path, "an existing file or folder", "nothing there", f"check {_dashed(flag.name)}")
            if isinstance(flag.mark, Out):
                ensure_writable_parent(path)


def ensure_writable_parent(path: Path) -> None:
    """Create the parent folder of `path`.

    Raises:
        InputError: if it cannot be created or is not writable.
    """
    advice = "choose another output folder or change its permissions"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path.parent, "a folder that can be created", error.strerror or str(error), advice) from error
    if not os.access(path.parent, os.W_OK):
        raise InputError(path.parent, "a folder that can be written", "no write permission", advice)


def _write_stats(
    stats_file: Path, stage: str, summary: str | None, outputs: list[Any], options: Options | None
) -> None:
    from stages.shared.artifacts import write_json
    from stages.shared.costs import spent
    from stages.shared.digest import code_digest

    write_json(
        stats_file,
        {
            "stage": stage,
            "code": code_digest(f"stages.{stage}"),
            "summary": summary,
            "warnings": log.warnings(),
            **spent(),
            "output_mb": sum(_size_bytes(path) for path in outputs if path) / 1e6,
            "options": options.model_dump(mode="json") if options else {},
        },
    )


def _size_bytes(path: Path) -> int:
    """Bytes of a file or of all files in a folder; none for another name of a file that an earlier stage wrote.

    Simulated scenes share a folder, in which another job may take its unfinished files away meanwhile.
    """
    files = [Path(where, name) for where, _, names in os.walk(path) for name in names] if path.is_dir() else [path]
    total = 0
    for file in files:
        with contextlib.suppress(FileNotFoundError):
            about = file.stat()
            total += about.st_size if about.st_nlink == 1 else 0
    return total


def _report_failure(stage: str, error: BaseException, log_file: Path | None) -> int:
    """Print the failure in one line, write the traceback to the log, and return the exit code."""
    log.logger.info("traceback:\n%s", traceback.format_exc())
    if isinstance(error, InputError):
        print(f"{stage}: {error}", file=sys.stderr)
        return 2
    if isinstance(error, KeyboardInterrupt):
        print(f"{stage}: interrupted; no incomplete output is left", file=sys.stderr)
        return 130
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        where = f"{error.filename}: " if error.filename else ""  # unknown for a write to an open file
        print(f"{stage}: {where}the disk is full; free some space and run again", file=sys.stderr)
        return 2
    if isinstance(error, SystemExit):
        if isinstance(error.code, str):
            print(f"{stage}: {error.code}", file=sys.stderr)
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    if log_file is None:
        traceback.print_exc()
    where = f"the traceback is in {log_file}" if log_file else "traceback above"
    said = " ".join(str(error).split())  # in one line, the last of the log, which the terminal shows
    print(f"{stage}: internal error: {type(error).__name__}: {said}; {where}", file=sys.stderr)
    return 1
