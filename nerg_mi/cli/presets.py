"""Options of ``nerg rays import`` that the readers of tracking files declare, and the part of them that help shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from nerg_mi.errors import NergError, parameter
from nerg_mi.options import MAIN
from nerg_mi.tracking.readers.base import list_options
from nerg_mi.tracking.readers.registry import (
    TABLE,
    collect_shared_options,
    get_reader,
    list_preset_names,
    parse_options,
    summarise_files,
)

from .declarations import HelpView, Parameter, extra


def make_preset_parameters() -> dict[str, Parameter]:
    """Return ``preset`` and the options of all registered readers."""
    presets = ", ".join(list_preset_names())
    help = f"Format of the files: {presets}.  [default: a table, see --map]"
    parameters = {"preset": extra(None, help, str, "--preset", group=MAIN)}
    for o in collect_shared_options():
        parameters[o.name] = extra(False if o.kind is bool else None, o.help, o.kind, o.flag, group=MAIN)
    return parameters


def choose_reader(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments ``reader`` and ``settings`` of an import for the values of those parameters."""
    options = {name: v for name, v in values.items() if name != "preset" and v is not None and v is not False}
    preset = values["preset"]
    if (preset is None) == ("columns" not in options):
        raise NergError(
            f"the format of the files is not given: add {parameter('preset', 'NAME')} or "
            f"{parameter('columns', 'COLUMNS')}; nerg rays guess proposes one"
        )
    reader = preset or TABLE
    return {"reader": reader, "settings": parse_options(reader, options)}


def view_presets(arguments: Sequence[str]) -> HelpView:
    """Show the options of the preset among the ``arguments``, or those of all formats and the presets."""
    values = [f"{a}={b}" if a == "--preset" else a for a, b in zip(arguments, [*arguments[1:], ""])]
    preset = next((value.partition("=")[2] for value in values if value.startswith("--preset=")), None)
    if preset is None and any(value.partition("=")[0] == "--map" for value in values):
        preset = TABLE
    names = {o.name for o in collect_shared_options()}
    if preset is None:
        return HelpView(
            "Options of a format: nerg rays import --preset NAME --help; of tables: nerg rays import --map COLUMNS "
            "--help.",
            frozenset(names - {"columns"}),
            {"preset": "Format of the files, see below.  [default: a table, see --map]"},
            {"Presets": [(name, summarise_files(get_reader(name))) for name in list_preset_names()]},
        )
    reader = get_reader(preset)
    options = {o.name: o for o in list_options(reader.Options) if o.flag}
    text = f"The preset {reader.name} reads {reader.files}. Frame: {reader.frame_description}."
    helps = {o.name: o.help + (f"  [default: {o.default_text}]" if o.default_text else "") for o in options.values()}
    return HelpView(text.replace("`", ""), frozenset(names - set(options)), {"preset": "Format of the files.", **helps})
