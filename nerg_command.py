"""Starting point of the command `nerg`.

It stands outside the package because importing `nerg_mi` fails on a machine whose libLLVM is unusable, and the command
that explains this, `nerg doctor`, has to start there all the same. `nerg_mi` sees that this module is loaded.
"""


def main() -> None:
    """Run the command line given in `sys.argv`; ends the process with the command's exit code."""
    from nerg_mi.cli import main

    main()
