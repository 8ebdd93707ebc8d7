"""What a run shows on a terminal and in a pipe, from the events that Snakemake logs."""

import io
import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from snakemake.settings.enums import Quietness
from snakemake.settings.types import OutputSettings
from snakemake_interface_logger_plugins.common import LogEvent

from snakemake_logger_plugin_motionsplat import COMPILING, LogHandler
from stages.shared import log


class Terminal(io.StringIO):
    """A stream that takes itself for a terminal."""

    def isatty(self) -> bool:
        return True


def handler(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, compiled: bool = True, **settings: Any) -> LogHandler:
    """The handler of a run whose standard error is `stream`, on a machine that has compiled kernels or none."""
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("snakemake_logger_plugin_motionsplat.kernels_compiled", lambda: compiled)
    made = LogHandler(OutputSettings(**settings), None)
    made.setFormatter(logging.Formatter("%(message)s"))
    return made


def tell(to: LogHandler, event: LogEvent | None, message: str = "", **fields: Any) -> None:
    record = logging.LogRecord("snakemake", logging.INFO, "", 0, message, None, None)
    vars(record).update(fields | ({"event": event} if event else {}))
    to.handle(record)


def start(to: LogHandler, jobid: int, rule: str, folder: Path, **wildcards: str) -> None:
    outputs = [str(folder / "x.arrow"), str(folder / f"stats/{rule}.json")]
    words = {"rule_name": rule, "output": outputs, "log": [str(folder / f"{rule}.log")], "wildcards": wildcards}
    tell(to, LogEvent.JOB_INFO, jobid=jobid, **words)


def write_stats(folder: Path, rule: str, **content: Any) -> None:
    (folder / "stats").mkdir(exist_ok=True)
    (folder / f"stats/{rule}.json").write_text(json.dumps(content))


def test_a_finished_stage_is_one_line_with_its_seconds_and_its_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    tell(shown, LogEvent.WORKFLOW_STARTED, "SNAKEMAKE 9")
    tell(shown, None, "Building DAG of jobs...")
    tell(shown, LogEvent.RUN_INFO, "Job stats: 2", stats={"total": 2})
    start(shown, 1, "ba", tmp_path, seq="demo", setting="settings/fast/", round="round1/")
    write_stats(tmp_path, "ba", wall_s=4.42, summary="14 of 14 frames", warnings=["ba: demo: rough path"])
    tell(shown, LogEvent.JOB_FINISHED, job_id=1)
    tell(shown, LogEvent.PROGRESS, done=1, total=2)
    page = tmp_path / "report/index.html"
    tell(shown, LogEvent.JOB_INFO, jobid=2, rule_name="report", output=[str(page)], log=["r.log"], wildcards={})
    tell(shown, LogEvent.JOB_FINISHED, job_id=2)
    shown.close()
    shown.close()
    lines = stream.getvalue().splitlines()
    assert [" ".join(line.split()) for line in lines[:1]] == ["ba demo fast round1 4.4 s 14 of 14 frames"]
    assert lines[1].startswith("report ")
    assert lines[2:] == ["warning: demo fast round1: ba: demo: rough path", f"The report: {page}"]


def test_the_seconds_of_a_killed_run_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    start(shown, 1, "ba", tmp_path, seq="demo")
    write_stats(tmp_path, "ba", wall_s=900.0, taken_over_s=870.0, summary="14 of 14 frames")
    tell(shown, LogEvent.JOB_FINISHED, job_id=1)
    shown.close()
    (line,) = stream.getvalue().splitlines()
    assert " ".join(line.split()) == "ba demo 900.0 s (870 s of them before a kill) 14 of 14 frames"


def test_the_first_run_on_a_machine_says_once_that_kernels_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch, compiled=False)
    tell(shown, LogEvent.RUN_INFO, stats={"total": 5})
    shown.close()
    assert stream.getvalue().splitlines() == [COMPILING]


def test_nothing_to_do_still_says_where_the_report_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, stream = tmp_path / "index.html", io.StringIO()
    monkeypatch.setenv("MOTIONSPLAT_REPORT", str(page))
    for there in (False, True):
        if there:
            page.touch()
        shown = handler(stream, monkeypatch)
        tell(shown, None, "Nothing to be done (all requested files are present and up to date).")
        shown.close()
    nothing = "Nothing to be done (all requested files are present and up to date)."
    assert stream.getvalue().splitlines() == [nothing, nothing, f"The report: {page}"]


@pytest.mark.parametrize(
    ("free", "words"), [(9e9, "This run writes about 3.0 GB; 9.0 GB are free."), (2e9, "found 2.0 GB")]
)
def test_a_dry_run_ends_with_the_disk_that_its_jobs_take(
    free: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    stream = io.StringIO()
    shown = handler(stream, monkeypatch, dryrun=True)
    for jobid, megabytes in enumerate((1000, 2000, None)):  # the last writes next to nothing
        resources = SimpleNamespace() if megabytes is None else SimpleNamespace(disk_mb=megabytes)
        tell(shown, LogEvent.JOB_INFO, jobid=jobid, rule_name="flow", output=["pairs.arrow"], resources=resources)
    shown.close()
    shown.close()
    assert words in stream.getvalue().splitlines()[-1]
    assert stream.getvalue().count(words) == 1


def test_quiet_leaves_failures_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    shown = handler(stream, monkeypatch, compiled=False, quiet={Quietness.ALL})
    tell(shown, LogEvent.RUN_INFO, stats={"total": 5})
    start(shown, 1, "ba", tmp_path, seq="demo")
    tell(shown, LogEvent.JOB_FINISHED, job_id=1)
    assert stream.getvalue() == ""
    start(shown, 2, "flow", tmp_path, seq="demo")
    tell(shown, LogEvent.JOB_ERROR, jobid=2)
    assert "flow" in stream.getvalue()


def test_a_record_that_cannot_be_read_stops_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    tell(shown, LogEvent.JOB_FINISHED)  # without a number
    start(shown, 1, "ba", tmp_path, seq="demo")
    (tmp_path / "stats").mkdir()
    (tmp_path / "stats/ba.json").write_text('["no object"]')
    tell(shown, LogEvent.JOB_FINISHED, job_id=1)
    assert stream.getvalue().splitlines()[-1].startswith("ba ")


def test_a_failed_stage_is_told_with_the_last_words_of_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    start(shown, 7, "flow", tmp_path, seq="demo")
    (tmp_path / "flow.log").write_text("INFO options\nflow.estimate: a.png: expected a frame, found nothing\n")
    tell(shown, LogEvent.JOB_ERROR, jobid=7)
    tell(shown, LogEvent.ERROR, "WorkflowError:\nAt least one job did not complete successfully.")
    tell(shown, LogEvent.ERROR, "MissingInputException: no such file")
    shown.close()
    first, other, last = stream.getvalue().splitlines()
    assert "FAILED  flow.estimate: a.png: expected a frame, found nothing" in first
    assert other == "MissingInputException: no such file"
    assert last.startswith("failed: flow demo: flow.estimate: a.png")


def test_of_a_failed_group_only_the_stage_that_was_cut_off_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    stages = {1: "inspect", 2: "flow", 3: "ba"}
    for jobid, rule in stages.items():
        start(shown, jobid, rule, tmp_path, seq="demo")
    (tmp_path / "inspect.log").write_text("2026 INFO options\n2026 INFO done: 6 frames\n")
    (tmp_path / "flow.log").write_text("2026 INFO options\n2026 INFO edge: 3 of 9\n")
    about = {"groupid": "poses", "aux_logs": ["slurm/1.log"], "job_error_info": [{"jobid": jobid} for jobid in stages]}
    tell(shown, LogEvent.GROUP_ERROR, "Error in group poses", **about)
    for jobid in stages:
        tell(shown, LogEvent.JOB_ERROR, jobid=jobid)
    (line,) = stream.getvalue().splitlines()
    assert "flow" in line
    assert "FAILED  2026 INFO edge: 3 of 9" in line
    for jobid, rule in stages.items():  # and again, until it ends well
        start(shown, jobid, rule, tmp_path, seq="demo")
        tell(shown, LogEvent.JOB_FINISHED, job_id=jobid)
    shown.close()
    assert "failed:" not in stream.getvalue()


@pytest.mark.parametrize(("stream", "barred"), [(Terminal(), True), (io.StringIO(), False)])
def test_the_bar_over_all_jobs_is_for_terminals_alone(
    stream: io.StringIO, barred: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("snakemake_logger_plugin_motionsplat.REFRESH_S", 0.01)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("LINES", "40")
    shown = handler(stream, monkeypatch)
    tell(shown, LogEvent.RUN_INFO, stats={"total": 5})
    start(shown, 1, "gaussians", tmp_path, seq="demo")
    (tmp_path / "gaussians.log").write_text("INFO training: 100 of 1000\nINFO training: 400 of 1000, 3 min left\n")
    tell(shown, LogEvent.PROGRESS, done=2, total=5)
    for _ in range(200):
        if not barred or "gaussians demo 40 %, 3 min left" in stream.getvalue():
            break
        shown.stopped.wait(0.01)
    shown.close()
    said = stream.getvalue()
    assert ("2 of 5 jobs" in said and "gaussians demo 40 %, 3 min left" in said) if barred else said == ""


def test_where_there_is_no_terminal_a_line_tells_the_progress_of_every_running_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("snakemake_logger_plugin_motionsplat.PIPE_S", 0.01)
    stream = io.StringIO()
    shown = handler(stream, monkeypatch)
    for jobid, rule in enumerate(("flow", "ba", "scene")):  # the last has told nothing yet
        start(shown, jobid, rule, tmp_path, seq="demo")
    (tmp_path / "flow.log").write_text("INFO flow: 412 of 1000, 3 min left\n")
    (tmp_path / "ba.log").write_text("INFO windows: 1 of 4\nINFO windows: 4 of 4\n")
    tell(shown, LogEvent.RUN_INFO, stats={"total": 5})
    for _ in range(200):
        if stream.getvalue().count("\n") > 1:
            break
        shown.stopped.wait(0.01)
    shown.stopped.wait(0.05)  # time to repeat what is not to be repeated
    shown.close()
    lines = [" ".join(line.split()) for line in stream.getvalue().splitlines()]
    assert lines == ["flow demo running 412 of 1000, 3 min left", "ba demo running 4 of 4"]


def test_the_log_tells_tenths_and_what_takes_long_with_the_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("stages.shared.log.time.monotonic", lambda: now[0])
    log.setup(tmp_path / "a.log")
    for frame in log.progress(range(1000), "frames"):
        now[0] += 20.0 if frame < 3 else 0.01
    told = [line.partition("INFO ")[2] for line in (tmp_path / "a.log").read_text().splitlines()]
    assert told[:2] == ["frames: 2 of 1000, 5 h 33 min left", "frames: 100 of 1000, 6 min left"]
    assert told[-2:] == ["frames: 900 of 1000, 5 s left", "frames: 1000 of 1000"]
    assert len(told) == 11


def test_what_a_killed_run_had_done_does_not_shorten_the_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("stages.shared.log.time.monotonic", lambda: now[0])
    log.setup(tmp_path / "a.log")
    for frame in log.progress(range(1000), "frames"):
        now[0] += 0.0 if frame < 850 else 1.0
    told = [line.partition("INFO ")[2] for line in (tmp_path / "a.log").read_text().splitlines()]
    assert "frames: 900 of 1000, 2 min left" in told


def test_what_is_done_at_once_counts_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 64 edges, 60 of them kept by a killed run: the 40 others take 31 s each."""
    now = [0.0]
    monkeypatch.setattr("stages.shared.log.time.monotonic", lambda: now[0])
    log.setup(tmp_path / "a.log")

    def blocks() -> Iterator[int]:
        for block in range(100):
            now[0] += 0.0 if block < 60 else 31.0
            yield 64

    for _ in log.progress(blocks(), "edges", 6400, size=int):
        pass
    told = [line.partition("INFO ")[2] for line in (tmp_path / "a.log").read_text().splitlines()]
    assert told[:7] == [*(f"edges: {640 * k} of 6400" for k in range(1, 7)), "edges: 3904 of 6400, 20 min left"]
    assert told[-2:] == ["edges: 6336 of 6400, 31 s left", "edges: 6400 of 6400"]


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (99, "99 s"), (101, "2 min"), (5800, "97 min"), (7800, "2 h 10 min")]
)
def test_durations_are_told_to_those_who_wait(seconds: float, words: str) -> None:
    assert log.duration(seconds) == words


def test_warnings_reach_the_log_once_where_standard_error_goes_there_too(tmp_path: Path) -> None:
    """As in the workflow, so that the words of a crash are not lost."""
    path = tmp_path / "a.log"
    path.write_text("of an earlier run\n")
    code = (
        "import sys, pathlib; from stages.shared import log; log.setup(pathlib.Path(sys.argv[1])); "
        "log.logger.warning('rough path'); print('crashed', file=sys.stderr, flush=True); "
        "log.logger.info('after'); assert log.warnings() == ['rough path']"
    )
    with path.open("a") as stderr:
        subprocess.run([sys.executable, "-c", code, str(path)], stderr=stderr, check=True)
    assert [line.split(" ", 2)[-1] for line in path.read_text().splitlines()] == [
        "WARNING rough path",
        "crashed",
        "INFO after",
    ]


def test_warnings_reach_standard_error_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.setup(tmp_path / "a.log")
    log.logger.warning("rough path")
    assert capsys.readouterr().err == "rough path\n"
