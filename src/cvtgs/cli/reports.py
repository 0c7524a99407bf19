"""The file of ``--report``: the report of a run, or one entry for each of many scenes."""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import cvtgs
from cvtgs.cli.jobs import SceneJob
from cvtgs.errors import OutputError, OutputExistsError, RunError
from cvtgs.io.atomic import write_atomically


class ReportFile:
    """Writes the report of a run, or collects those of many scenes."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._entries: list[dict[str, Any]] = []

    def add(self, job: SceneJob, report: "cvtgs.SimplifyReport") -> None:
        """Write the report of one scene; keep that of one of many."""
        if self._options.report is None:
            return
        text = report.to_json()
        if job.is_one_of_many:
            self._keep(job, report=json.loads(text))
        else:
            self._write(text, f"the scene {job.options.output} was")

    def add_error(self, job: SceneJob, error: Exception) -> None:
        """Keep the error of one of many scenes."""
        self._keep(job, error=str(error))

    def write_all(self) -> None:
        """Write the entries of many scenes."""
        if self._options.report is not None and self._entries:
            text = json.dumps(self._entries, indent=2) + "\n"
            self._write(text, f"the scenes in {self._options.folder} were")

    def _keep(self, job: SceneJob, *, error: str | None = None, report: object = None) -> None:
        paths = {"input": str(job.options.input), "output": str(job.options.output)}
        self._entries.append({**paths, "error": error, "report": report})

    def _write(self, text: str, written: str) -> None:
        options = self._options
        try:
            write_atomically(options.report, text.encode(), overwrite=options.overwrite)
        except (OutputError, OutputExistsError) as error:
            reason = str(error).removesuffix("; nothing was written.").rstrip(".")
            raise OutputError(f"{reason}; {written} written, the report was not.") from error


@contextmanager
def report_file(options: argparse.Namespace) -> Iterator[ReportFile]:
    """Check that the file can be written; at the end, write the entries of many scenes.

    They are written even if some of the scenes failed, or the command is interrupted.
    """
    if options.report is not None:
        cvtgs.io.check_output(options.report, overwrite=options.overwrite)
    file = ReportFile(options)
    try:
        yield file
    except RunError:
        file.write_all()
        raise
    except BaseException:
        with suppress(OutputError, OutputExistsError):  # one error is enough
            file.write_all()
        raise
    file.write_all()
