"""The sub-commands, and where their options come from."""

import subprocess
import sys

import typer.main

from nerg_mi.cli.rays import rays_app
from nerg_mi.cli.rays.commands import make_rays_app
from nerg_mi.rays.readers.registry import shared_options


def test_sub_commands():
    commands = typer.main.get_command(rays_app).commands
    assert set(commands) == {"import", "guess", "show", "filter", "split", "plot"}
    assert all(command.help for command in commands.values())


def test_the_import_has_the_options_of_all_readers():
    command = typer.main.get_command(make_rays_app()).commands["import"]
    flags = [flag for parameter in command.params for flag in parameter.opts]
    assert len(flags) == len(set(flags)) and {o.flag for o in shared_options()} <= set(flags)
    names = [parameter.name for parameter in command.params]
    assert names[:3] == ["files", "output", "preset"] and names[-3:] == ["skip_bad_lines", "pseudonyms", "salt"]


def test_help_loads_no_renderer():
    code = "import sys; import nerg_mi.cli.rays; print(*{'mitsuba', 'drjit', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""
