"""The sub-commands, and where their options come from."""

import subprocess
import sys

from nerg_mi.rays.readers.registry import shared_options
from tools.command_pages import commands


def test_the_import_has_the_options_of_all_readers():
    parsers = {path.removeprefix("nerg rays "): command for path, command, _ in commands() if path[:9] == "nerg rays"}
    assert set(parsers) == {"import", "guess", "show", "filter", "split", "plot"}
    assert all(command.help for command in parsers.values())
    flags = [flag for parameter in parsers["import"].params for flag in parameter.opts]
    assert len(flags) == len(set(flags)) and {o.flag for o in shared_options()} <= set(flags)
    assert [parameter.name for parameter in parsers["import"].params][:3] == ["files", "output", "preset"]


def test_help_loads_no_renderer():
    code = "import sys; import nerg_mi.workflows.rays; print(*{'mitsuba', 'drjit', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""
