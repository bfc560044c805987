"""The report of a run: one self-contained HTML file, and the page to put its teeth right."""

from __future__ import annotations

from pathlib import Path


def run_report(workspace: str | Path, *, anonymous: bool = False) -> Path:
    """Write ``WORKSPACE/report.html`` from what the workspace holds, and ``check.html`` beside it.

    Args:
        anonymous: write ``report_anonymous.html`` instead, to be passed on: without names of files,
            folders, host and user, without dates, and without links to what is not in it. The
            photographs themselves are in it.

    Returns:
        The file.

    Raises:
        RequestError: the folder is not a workspace, or can't be written to.
    """
    from pipeline.process.privacy import kept_for, share_for
    from pipeline.studies.report.run import write_run_report
    from pipeline.untrusted.paths import given_path

    home = given_path(workspace, "workspace")
    with kept_for(share_for(home)):
        return write_run_report(home, anonymous)
