"""What a stage's command line says, and with which exit code it ends, when it cannot go on."""

import errno
from pathlib import Path

import pytest

from stages.shared import cli


def ending(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    """Exit code and standard error of a stage that ends in `error`."""

    def main() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        cli.run(main, [])
    return ended.value.code, capsys.readouterr().err


@pytest.mark.parametrize(("name", "told"), [(None, ": the disk is full"), ("a.png", "a.png: the disk is full")])
def test_a_full_disk_is_told_with_the_file_where_it_is_known(
    name: str | None, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = ending(OSError(errno.ENOSPC, "No space left on device", name), capsys)
    assert code == 2
    assert told in said
    assert "None" not in said


@pytest.mark.parametrize(("given", "expected"), [(None, 0), (3, 3), ("no such camera", 1)])
def test_an_exit_by_code_or_by_text(given: int | str | None, expected: int, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = ending(SystemExit(given), capsys)
    assert code == expected
    assert said.strip().endswith(given if isinstance(given, str) else "")


def test_what_a_stage_wrote_is_counted_once_whatever_it_is_called(tmp_path: Path) -> None:
    for name, size in (("a.arrow", 300), ("masks/1.png", 20), ("masks/more/2.png", 3)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(bytes(size))
    assert [cli._size_bytes(tmp_path / name) for name in ("a.arrow", "masks", "none")] == [300, 23, 0]
    (tmp_path / "b.arrow").hardlink_to(tmp_path / "a.arrow")  # as `lens` does with the flow that it leaves as it is
    assert cli._size_bytes(tmp_path / "b.arrow") == 0


def test_files_that_another_job_takes_away_have_no_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "frame.png").write_bytes(bytes(20))
    monkeypatch.setattr(cli.os, "walk", lambda path: [(str(path), [], ["frame.png", "other.png.partial"])])
    assert cli._size_bytes(tmp_path) == 20
