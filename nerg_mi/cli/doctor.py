"""`nerg doctor`: the command line of `nerg_mi.diagnosis`."""

from __future__ import annotations

import typer


def doctor_command() -> None:
    """Say what works on this machine, and how to mend what does not.

    Ends with exit code 0 if some compiled variant of Mitsuba works, else with 1.
    """
    from nerg_mi.diagnosis import examine

    diagnosis = examine()
    print(diagnosis)
    raise typer.Exit(0 if diagnosis.usable else 1)
