"""``nerg doctor``: Check the installation and suggest fixes.

What it needs is imported when it runs, because it must work without Mitsuba.
"""

from __future__ import annotations

import typer

from nerg_mi.progress import Reporter

from .declarations import command


@command("doctor", more="The exit code is 0 if a compiled variant of Mitsuba works, else 1.")
def diagnose(reporter: Reporter) -> None:
    """Report the state of the installation. Raises ``typer.Exit``."""
    from nerg_mi.diagnosis import run_diagnosis

    diagnosis = run_diagnosis()
    reporter.message(str(diagnosis))
    raise typer.Exit(0 if diagnosis.is_usable else 1)
