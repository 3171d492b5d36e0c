"""The command `nerg`: finds the sub-command, runs it, and tells an expected error in one sentence.

Commands are declared in the modules of their workflows (`nerg_mi.workflows.base`), and found and built by `.building`.
"""

from __future__ import annotations

import os
import sys
import traceback

from .ending import INTERRUPTED, CtrlC, exit_code, open_streams, quiet_ctrl_c, shorten_values

with quiet_ctrl_c():
    from .building import DEBUG, build_app


def main(arguments: list[str] | None = None) -> None:
    """Run the command line `arguments` (default: that of the process) and end the process.

    Exit codes: 0 done; 1 an error that the user can correct, told in one sentence; 2 a wrong command line; 70 a mistake
    in the program itself, which is said to be one; 130 interrupted. With --debug (also: --traceback, or
    NERG_TRACEBACK=1) the traceback is shown before. The reader of the output may go away at any time: nothing is said
    about that. A command that ends early on Ctrl-C leaves its outputs whole or absent and raises `KeyboardInterrupt`,
    whose message, where it has one, says how to go on.
    """
    open_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    asked_by_environment = os.environ.get("NERG_TRACEBACK", "0") not in ("", "0")
    debug = asked_by_environment or not set(DEBUG).isdisjoint(arguments)
    # Allowed anywhere on the line: it is added after something went wrong, at the end.
    arguments = [a for a in arguments if a not in DEBUG]
    with CtrlC() as ctrl_c:
        try:
            try:
                build_app(arguments)(arguments, prog_name="nerg")
            finally:
                sys.stdout.flush()
        except BaseException as error:
            interrupt = ctrl_c.find_interrupt(error)
            if interrupt is not None:
                print(str(interrupt) or "Interrupted.", file=sys.stderr)
                sys.exit(INTERRUPTED)
            if not isinstance(error, Exception):  # the end of a command
                raise
            if debug:
                traceback.print_exception(error)
            code, text = exit_code(error)
            print(f"nerg: {shorten_values(text, arguments)}", file=sys.stderr)
            sys.exit(code)
