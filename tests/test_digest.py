"""The digest of a stage's code: what changes it, and the compiled files that it is read from."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.shared import digest

CACHED = (digest.code_digest, digest._file, digest._source, digest._imports, digest._instructions)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The file of a module that imports another one, in a repository of its own."""
    monkeypatch.setattr(digest, "ROOT", tmp_path)
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages/__init__.py").touch()
    (tmp_path / "stages/used.py").write_text("HALF = 0.5\n")
    file = tmp_path / "stages/user.py"
    file.write_text('from stages.used import HALF\n\n\ndef half(x):\n    """Half."""\n    return HALF * x\n')
    yield file
    forget()


def forget() -> None:
    """As in a new process."""
    for function in CACHED:
        function.cache_clear()


def found() -> str:
    """The digest, as a new process finds it."""
    forget()
    return digest.code_digest("stages.user")


def test_only_what_runs_changes_it(module: Path) -> None:
    before, text = found(), module.read_text()
    module.write_text(text.replace("Half.", "Half of x.").replace("def half", "# moved\n\ndef half"))
    assert found() == before
    (module.parent / "used.py").write_text("HALF = 0.4\n")
    assert found() != before


def test_weights_beside_a_module_change_it(module: Path) -> None:
    before, seen = found(), set()
    for content in (b"one", b"other"):
        (module.parent / "used.safetensors").write_bytes(content)
        seen.add(found())
    assert len(seen | {before}) == 3
    (module.parent / "unused.safetensors").write_bytes(b"one")
    assert found() in seen


def test_a_change_of_no_size_at_no_time_is_seen(module: Path) -> None:
    before, stat = found(), module.stat()
    module.write_text(module.read_text().replace("HALF * x", "HALF + x"))
    os.utime(module, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert module.stat().st_size == stat.st_size
    assert found() != before


def test_it_is_the_same_with_and_without_kept_files(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = found()
    kept = list((module.parent / "__pycache__").iterdir())
    assert len(kept) == 3
    with monkeypatch.context() as once:
        once.setattr("py_compile.compile", lambda *_, **__: pytest.fail("compiled again"))
        assert found() == before
    for file in kept:
        file.write_bytes(file.read_bytes()[:20])  # as a machine leaves it that stopped
    assert found() == before
    for file in kept:
        file.unlink()
    kept[0].parent.rmdir()
    kept[0].parent.touch()  # a folder cannot be made here, as in a checkout that may only be read
    assert found() == before
