"""Terminal output of a run: a line per finished stage, a bar over all jobs, at the end warnings and the report's path.

The bar names the running jobs, with their progress and the time left. Where there is no terminal, a line per running
job tells these once a minute.

Snakemake finds logger plugins by the name of the package; profiles/default chooses this one. Results and warnings of a
stage are read from its time file (`summary` and `warnings` in stats/<stage>.json); all else is in its log.
"""

import json
import logging
import os
import re
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from snakemake.logging import DefaultFilter
from snakemake.settings.enums import Quietness
from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent
from tqdm import tqdm

from stages import kernels_compiled
from stages.shared import disk
from stages.shared.errors import InputError

COMPILING = "First run on this machine: kernels are compiled on the way, once, about a minute of CPU time in all."
REFRESH_S = 0.5
PIPE_S = 60.0
"""Between two lines on the progress of a job where there is no terminal."""
BAR = "{percentage:3.0f} % |{bar:20}| {n_fmt} of {total_fmt} jobs, {elapsed}{postfix}"
PROGRESS = re.compile(r": (\d+) of (\d+)(, [^,\n]+ left)?$", re.MULTILINE)
"""The lines that `stages.shared.log.progress` writes to the log of a job."""
TAIL_BYTES = 4096
SILENT = frozenset(
    (
        *(LogEvent.WORKFLOW_STARTED, LogEvent.RESOURCES_INFO, LogEvent.JOB_STARTED, LogEvent.GROUP_INFO),
        *(LogEvent.RULEGRAPH, LogEvent.DEBUG_DAG),
    )
)
NOISE = re.compile(
    r"Building DAG|Select jobs|Execute \d+ job|Using shell|Assuming unrestricted|Provided|Rules claiming|host: |"
    r"Using (workflow specific )?profile|Config file .* is extended|Conda environments|Complete log|Shutting down|"
    r"Storing output|Submitted|Job stats|Trying to restart|Elapsed time|Exiting because|"
    r"(WorkflowError:\s*)?At least one job|RuleException:\s*CalledProcessError"
)
"""Messages of Snakemake that are not shown: they are of no use to the user, or our lines replace them. Snakemake's own
log file has them."""


@dataclass
class Job:
    """A job that Snakemake has started.

    Attributes:
        about: sequence, setting and round. page: the report, if the job writes it.
        told: its progress when a line on it was last printed.
    """

    rule: str
    about: str
    log: Path | None
    stats: Path | None
    page: Path | None
    started_s: float = field(default_factory=time.monotonic)
    told: str = ""


class LogHandler(LogHandlerBase):
    """Prints the events of a run; in a dry run and with --verbose the output is that of Snakemake itself."""

    def __post_init__(self) -> None:
        self.stream: TextIO = sys.stdout if self.common_settings.stdout else sys.stderr
        self.plain = self.common_settings.dryrun or self.common_settings.verbose
        self.default = DefaultFilter(
            self.common_settings.quiet,
            self.common_settings.debug_dag,
            self.common_settings.verbose,
            self.common_settings.dryrun,
            self.common_settings.printshellcmds,
        )
        self.quiet = bool({Quietness.ALL, Quietness.RULES} & set(self.common_settings.quiet or ()))
        self.running: dict[int, Job] = {}
        self.last_words: dict[str, list[str]] = {"failed": [], "warning": []}
        self.page: Path | None = None
        self.planned_mb, self.planned = 0, list[str]()
        self.bar: tqdm | None = None
        self.stopped = threading.Event()

    writes_to_stream, writes_to_file = True, False
    has_filter, has_formatter, needs_rulegraph = True, False, False

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record, if it is of use to the user. An error in one record does not affect the others."""
        try:
            self._show(record)
        except Exception:
            self.handleError(record)

    def _show(self, record: logging.LogRecord) -> None:
        event = getattr(record, "event", None)
        if self.plain:
            self._pass_on(record)
            self._plan(vars(record) if event == LogEvent.JOB_INFO else {})
        elif event == LogEvent.RUN_INFO:
            self._start(int(vars(record).get("stats", {}).get("total", 0)))
        elif event == LogEvent.JOB_INFO:
            self.running[vars(record)["jobid"]] = _job(vars(record))
        elif event == LogEvent.JOB_FINISHED:
            self._finish(vars(record)["job_id"])
        elif event == LogEvent.GROUP_ERROR:
            self._fail_group(vars(record))
        elif event == LogEvent.JOB_ERROR:
            self._fail(vars(record)["jobid"])
        elif event == LogEvent.PROGRESS:
            self._advance(vars(record)["done"], vars(record)["total"])
        elif record.getMessage().startswith("Nothing to be done"):
            self._pass_on(record)
            self.page = _page_there()
        elif event not in SILENT and not NOISE.match(record.getMessage().strip()):
            self._pass_on(record)

    def close(self) -> None:
        """Print failures, warnings and the path of the report. Snakemake closes its handlers more than once."""
        self.stopped.set()
        self.acquire()
        try:
            if self.bar is not None:
                self.bar.close()
                self.bar = None
        finally:
            self.release()
        for kind, lines in self.last_words.items():
            for line in dict.fromkeys(lines):
                self._print(f"{kind}: {line}")
            lines.clear()
        if self.page is not None:
            self._print(f"The report: {self.page.resolve()}")
            self.page = None
        if self.planned_mb and self.common_settings.dryrun and not self.quiet:
            self._tell_disk()
            self.planned_mb = 0
        super().close()

    def _pass_on(self, record: logging.LogRecord) -> None:
        if self.default.filter(record) and (text := self.format(record).strip("\n")):
            self._print(text)

    def _print(self, line: str) -> None:
        tqdm.write(line, file=self.stream)
        self.stream.flush()

    def _plan(self, said: dict[str, Any]) -> None:
        """Note what a job of a dry run would write."""
        self.planned_mb += getattr(said.get("resources"), "disk_mb", 0)
        self.planned += map(str, said.get("output") or [])

    def _tell_disk(self) -> None:
        """What a dry run's jobs would write beside what is free; a run tells it itself before its first job."""
        try:
            self._print(disk.told(self.planned_mb, self.planned))
        except InputError as error:
            self._print(str(error))

    def _start(self, total: int) -> None:
        """Show the bar if the output is a terminal, and follow the running jobs."""
        if self.bar is not None or not total or self.quiet:
            return
        if not kernels_compiled():
            self._print(COMPILING)
        on_terminal = self.stream.isatty()
        if on_terminal:
            self.bar = tqdm(total=total, file=self.stream, bar_format=BAR, leave=False, disable=False)
        threading.Thread(target=self._follow, args=[on_terminal], daemon=True).start()

    def _follow(self, on_terminal: bool) -> None:
        """Tell the progress of the running jobs, which is read from their logs: in the bar, or in lines of its own."""
        while not self.stopped.wait(REFRESH_S if on_terminal else PIPE_S):
            self.acquire()
            try:
                if self.bar is not None:
                    running = [f"{job.rule} {job.about}{_progress(job)[0]}" for job in self.running.values()]
                    self.bar.set_postfix_str(", ".join(running), refresh=True)
                elif not on_terminal:
                    self._tell_progress()
            finally:
                self.release()

    def _tell_progress(self) -> None:
        """A line for every running job whose log has told more since its last line."""
        for job in self.running.values():
            _, words = _progress(job)
            if words and words != job.told:
                job.told = words
                self._print(f"{job.rule:<10} {job.about:<16}  running  {words}")

    def _finish(self, jobid: int) -> None:
        job = self.running.pop(jobid, None)
        if job is None or job.log is None:
            return  # a target such as `all`
        stats = _read(job.stats)
        seconds = stats.get("wall_s") or time.monotonic() - job.started_s
        taken_over = f" ({stats['taken_over_s']:.0f} s of them before a kill)" if stats.get("taken_over_s") else ""
        if not self.quiet:
            words = f"{seconds:7.1f} s{taken_over}  {stats.get('summary') or ''}"
            self._print(f"{job.rule:<10} {job.about:<16} {words}".rstrip())
        told = f"{job.rule} {job.about}: "  # a failure before a successful retry is not reported
        self.last_words["failed"] = [line for line in self.last_words["failed"] if not line.startswith(told)]
        self.last_words["warning"] += [f"{job.about}: {line}" for line in stats.get("warnings", [])]
        self.page = job.page or self.page

    def _fail(self, jobid: int) -> None:
        job = self.running.pop(jobid, None)
        if job is None:
            return
        words = _tail(job.log).strip().splitlines()
        reason = f"{words[-1] if words else 'no word in its log'} (log: {job.log})"
        self._print(f"{job.rule:<10} {job.about:<16}  FAILED  {reason}")
        self.last_words["failed"].append(f"{job.rule} {job.about}: {reason}")

    def _fail_group(self, said: dict[str, Any]) -> None:
        """Report the stages of a failed group that were running: not those that had finished or not started."""
        jobids = [about["jobid"] for about in said["job_error_info"]]
        cut_off = [jobid for jobid in jobids if jobid in self.running and _was_cut_off(self.running[jobid])]
        for jobid in cut_off:
            self._fail(jobid)
        for jobid in jobids:  # each is reported again as failed
            self.running.pop(jobid, None)
        if not cut_off:
            self._print(f"{said['groupid']:<27}  FAILED  no stage says why ({', '.join(map(str, said['aux_logs']))})")

    def _advance(self, done: int, total: int) -> None:
        if self.bar is not None:
            self.bar.total, self.bar.n = total, done
            self.bar.refresh()


def _job(said: dict[str, Any]) -> Job:
    """The job that a job-info record describes."""
    outputs = [Path(str(path)) for path in said.get("output") or []]
    wildcards = said.get("wildcards") or {}
    parts = [wildcards.get("seq"), *(str(wildcards.get(key, "")).rstrip("/") for key in ("setting", "round"))]
    return Job(
        rule=said["rule_name"],
        about=" ".join(part.removeprefix("settings/") for part in parts if part),
        log=Path(str(said["log"][0])) if said.get("log") else None,
        stats=next((path for path in outputs if path.parent.name == "stats" and path.suffix == ".json"), None),
        page=next((path for path in outputs if path.name == "index.html"), None),
    )


def _page_there() -> Path | None:
    """The report of an earlier run, at the path that the workflow sets; None if it does not exist."""
    page = Path(os.environ.get("MOTIONSPLAT_REPORT", ""))
    return page if page.is_file() else None


def _read(stats: Path | None) -> dict[str, Any]:
    """The content of a job's time file; empty if the job has none, as that of the report."""
    try:
        return dict(json.loads(stats.read_text(encoding="utf-8"))) if stats else {}
    except (OSError, ValueError, TypeError):  # on a cluster the file may arrive after the event
        return {}


def _tail(log: Path | None) -> str:
    try:
        return log.read_bytes()[-TAIL_BYTES:].decode("utf-8", errors="replace") if log else ""
    except OSError:
        return ""


def _was_cut_off(job: Job) -> bool:
    """Whether the job started and did not finish, by its log: `stages.shared.cli` writes "done: ..." at the end."""
    words = _tail(job.log).strip().splitlines()  # Snakemake creates empty logs for stages that never started
    return bool(words) and " done: " not in words[-1]


def _progress(job: Job) -> tuple[str, str]:
    """The progress of a job from the last such line in its log: (" 41 %, 3 min left", "412 of 1000, 3 min left")."""
    found = PROGRESS.findall(_tail(job.log))
    if not found:
        return "", ""
    done, total, left = found[-1]
    return f" {100 * int(done) // max(int(total), 1)} %{left}", f"{done} of {total}{left}"
