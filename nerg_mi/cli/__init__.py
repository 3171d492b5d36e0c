"""The command ``nerg``: finds and runs the sub-command, and reports errors of the user in one sentence.

Commands are rows of `.table`, and built by `.building`. Python functions have the same options, with underscores
instead of dashes, and more that only experts set. ``nerg --version`` prints the version. ``--debug``, anywhere on the
line (or ``NERG_TRACEBACK=1``), prints the traceback of an error.

Exit codes: 0 success; 1 an error that the user can fix, in one sentence; 2 a wrong command line; 70 a bug in the
program; 130 after Ctrl-C.

Completion in bash, zsh or fish: ``nerg --install-completion`` writes a script for the shell and a line into its
configuration; ``nerg --show-completion`` prints them. ``_NERG_COMPLETE=source_bash nerg`` (``source_zsh``,
``source_fish``) prints the script of one shell.

Commands that open network connections: those with ``--scheduler tcp://...`` or ``tls://...`` connect to a Dask
cluster and send the job's inputs, recordings included, to its workers; ``nerg worker`` connects to a scheduler and
runs what it is sent; ``nerg view`` listens on a port.
"""

from __future__ import annotations

import os
import sys
import traceback

from .ending import INTERRUPTED, CtrlC, exit_code, open_streams, quiet_ctrl_c, shorten_values

with quiet_ctrl_c():
    from nerg_mi.errors import clean_text
    from nerg_mi.memory import NUMPY_MEGABYTES, SCIPY_MEGABYTES, require_address_space

    from .building import DEBUG, build_app, choose_spelling


def main(arguments: list[str] | None = None) -> None:
    """Run the command line ``arguments`` (default: those of the process) and exit.

    The exit codes are 0 for success, 1 for an error that the user can correct, 2 for a wrong command line, 70 for a
    bug, and 130 after an interruption. With --debug (also --traceback, or NERG_TRACEBACK=1) the traceback is printed,
    too. If the reader of the output closes it, no error is reported. A command that Ctrl-C ends leaves its outputs
    complete or absent, and may raise `KeyboardInterrupt` with a message on how to resume.
    """
    open_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    requested_by_environment = os.environ.get("NERG_TRACEBACK", "0") not in ("", "0")
    debug = requested_by_environment or not set(DEBUG).isdisjoint(arguments)
    # Accepted anywhere, since users append it after an error.
    arguments = [a for a in arguments if a not in DEBUG]
    with CtrlC() as ctrl_c:
        try:
            try:
                require_address_space(NUMPY_MEGABYTES + SCIPY_MEGABYTES, "this command")
                build_app(arguments)(arguments, prog_name="nerg")
            finally:
                sys.stdout.flush()
        except BaseException as error:
            interrupt = ctrl_c.find_interrupt(error)
            if interrupt is not None:
                print(
                    clean_text("".join(map(str, interrupt.args)), choose_spelling(arguments)) or "Interrupted.",
                    file=sys.stderr,
                )
                sys.exit(INTERRUPTED)
            if not isinstance(error, Exception):  # normal end of a command
                raise
            if debug:
                traceback.print_exception(error)
            code, text = exit_code(error)
            text = clean_text(shorten_values(text, arguments), choose_spelling(arguments))
            print(f"nerg: {text}", file=sys.stderr)
            sys.exit(code)
