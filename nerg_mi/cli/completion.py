"""Completion of the command line in bash, zsh and fish: which sub-command the words on the line are about.

typer answers the shell (``nerg --install-completion``). It asks by the variable ``_NERG_COMPLETE`` with the line in
another variable, and without arguments, so that the command whose options are wanted has to be found there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

ASKS = "_NERG_COMPLETE"
"""Set where a shell asks what could follow."""
_LINES = ("COMP_WORDS", "_TYPER_COMPLETE_ARGS")  # bash; zsh, fish and PowerShell


def completed_command(environment: Mapping[str, str], commands: Collection[str]) -> str | None:
    """The one of ``commands`` whose sub-commands or options a shell asks for; None where it asks for none of them."""
    if ASKS not in environment:
        return None
    words = next((environment[name].split() for name in _LINES if name in environment), [])
    return next((word for word in words[1:] if word in commands), None)
