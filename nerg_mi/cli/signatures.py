"""Commands from the signatures of functions: arguments, options, ranges, defaults and help texts.

A signature is read from the source, so that help and completion do not import what the function computes with.
"""

from __future__ import annotations

import ast
import builtins
import importlib.util
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import Field, fields, is_dataclass, make_dataclass, replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, get_type_hints

import typer

from nerg_mi.errors import NergError, parameter
from nerg_mi.options import (
    OUTPUT,
    TRAINING,
    best_variant,
    cpu_threads,
    llvm_variant,
    option,
    parse_definitions,
    parse_numbers,
    parse_point,
)
from nerg_mi.progress import Reporter
from nerg_mi.ranges import CHANGES_RESULT, RANGE, find_ranges
from nerg_mi.tasks.settings import Parallel
from nerg_mi.threads import lower_priority

from .declarations import Command, argument, extra, import_function, out, select_backend
from .table import Row

_FILE = "FilePath"
"""Part of the annotation of parameters that may be files."""

_ARRAY = "ArrayLike"
"""Part of the annotation of points (M, 3), whose option is repeated."""

_EMPTY = inspect.Parameter.empty


def make_command(row: Row) -> Command:
    """Return the command of a ``row``."""
    # Imports all readers.
    readers: Any = import_module(f"{__package__}.presets") if row.presets else None
    function = read_signature(row.function)
    parameters = inspect.signature(function).parameters
    flags = {name: f"--{name.replace('_', '-')}" for name in parameters}
    texts = {
        name: re.sub("``(\\w+)``", lambda m: m[1] if m[1] in row.without else flags.get(m[1], _spell(m[1])), text)
        for name, text in read_parameter_texts(function).items()
    }
    presets = readers.make_preset_parameters() if readers else {}
    omitted = {"progress", *row.without, *presets}
    kinds = {name: _find_kind(function, name) for name in parameters if name not in omitted}
    arguments = {
        name: argument(texts[name], kinds[name], required=parameters[name].default is _EMPTY) for name in row.arguments
    }
    writes, outputs = "output" in parameters, dict[str, Any]()
    if writes:
        is_required = (row.output and not row.default_suffix) or parameters["output"].default is _EMPTY
        arguments["output"] = out(row.output or texts["output"], default=... if is_required else None)
    elif row.output:
        kind = list[Path] if row.several else Path
        outputs["output"] = out(row.output, kind, default=None if row.suffices else ...)
    for name, (help, *spellings) in row.more_outputs.items():
        outputs[name] = extra(None, help, Path, *(spellings or [f"--{name}"]), group=OUTPUT)
    arguments |= outputs | presets
    members, settings, ranges = list[Any](), dict[str, Any](), find_ranges(function)
    of_settings = [f.name for p in parameters.values() if is_dataclass(p.default) for f in fields(p.default)]
    headings = {name: heading for heading, names in row.groups.items() for name in names}
    for name in (name for name in kinds if name not in arguments):
        default = parameters[name].default
        if is_dataclass(default):
            settings[name] = type(default)
            group = getattr(default, "GROUP", TRAINING)
            hints = get_type_hints(type(default))
            shown = [f for f in fields(default) if "help" in f.metadata and f.name not in row.without]
            members += [(f.name, hints[f.name], _repeat(f, group)) for f in shown]
        else:
            names, parse = row.spellings.get(name, ()), _find_parser(function.__annotations__[name])
            text = texts[name]
            if kinds[name] == tuple[str, ...]:
                text = re.sub(r"( Default: .*)?$", r" Repeatable.\1", text, count=1)
            look: dict[str, Any] = {"metavar": "KEY=VALUE"} if parse is parse_definitions else {}
            group = headings.get(name, row.rest)
            made = option(default, text, *names, within=ranges.get(name), parse=parse, group=group, **look)
            members.append((name, kinds[name], made))
    device: dict[str, Any] = {"threads": ("int | None", cpu_threads())} if row.threads else {}
    device |= {"mode": ("str | None", best_variant()) if row.fastest else ("str", llvm_variant())}
    members += [(name, *made) for name, made in device.items() if row.computes and name not in row.without]
    options = make_dataclass("Options", members, frozen=True, kw_only=True)
    shown_names = {name for name, *_ in members}

    def run(*, options: Any, reporter: Reporter, **values: Any) -> None:
        paths = {name: path for name in outputs if (path := values.pop(name)) is not None}
        written = [path for value in paths.values() for path in (value if row.several else [value])]
        if row.suffices and not paths:
            raise NergError(f"no output is given: add {' or '.join(parameter(name, 'FILE') for name in outputs)}")
        for path in written:
            from nerg_mi.files.atomic import check_folder, check_writable  # which import NumPy

            if row.folder:
                check_folder(path)
            else:
                check_writable(path, *row.suffixes)
        if row.computes:
            mode = getattr(options, "mode", device["mode"][1].default)
            select_backend(mode, getattr(options, "threads", None), allow_scalar=row.fastest)
        chosen = {name: getattr(options, name) for name in kinds if hasattr(options, name)}
        for name, kind in settings.items():
            shown = [f.name for f in fields(kind) if hasattr(options, f.name)]
            chosen[name] = kind(**{field: getattr(options, field) for field in shown})
            if kind is Parallel and options.scheduler is not None and options.store is None and written:
                chosen[name] = replace(chosen[name], store=written[0].with_suffix(".tasks"))
        chosen |= {name: name in paths for name in row.more_outputs if name in kinds}
        if readers:
            chosen |= readers.choose_reader({name: values.pop(name) for name in presets})
        if row.default_suffix and values["output"] is None:
            values["output"] = values[row.arguments[0]].with_suffix(row.default_suffix)
        if row.waits:
            lower_priority()
        result: Any = import_function(row.function)(**values, **chosen, progress=reporter)
        if row.waits:
            reporter.message("press Ctrl-C to stop")
            result.wait()
        if row.prints:
            for part in result if isinstance(result, list) else [result]:
                reporter.message(part.to_text())
        if row.fails_unless and not getattr(result, row.fails_unless):
            raise typer.Exit(1)
        if row.several:
            written = [cast("Any", result).save(path) for path in written]
        elif paths:
            others = {name: paths[name] for name in row.more_outputs if name in paths}
            files = cast("Any", result).save(paths.get("output"), **others)
            written = files if isinstance(files, list) else written
        if row.folder:
            names = ", ".join(path.name for path in written)
            reporter.message(f"wrote {len(written)} files to {paths['output']}: {names}")
            return
        for path in written:
            reporter.message(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")

    summary, _, more = (inspect.getdoc(function) or "").partition("\n\nParameters\n")[0].partition("\n\n")
    return Command(
        row.name,
        run,
        " ".join(summary.split()),
        " ".join(more.split()),
        options,
        (*row.without, *(name for name in of_settings if name not in shown_names)),
        arguments,
        readers.view_presets if readers else None,
    )


def _spell(name: str) -> str:
    """Return the option of another command that a text names, or the name of something else."""
    return f"--{name.replace('_', '-')}" if "_" in name else name


def _repeat(setting: Field[Any], group: str) -> Any:
    """Return the option of a field of settings."""
    changes = setting.metadata[CHANGES_RESULT]
    return option(
        setting.default, setting.metadata["help"], within=setting.metadata[RANGE], changes_result=changes, group=group
    )


def _find_parser(annotation: str) -> Callable[[Any, str], Any] | None:
    """Return what parses the text of an option with this ``annotation``; None where its type is enough."""
    if annotation.startswith("Mapping[str, str]"):
        return parse_definitions
    if annotation.startswith("Mapping[str, Sequence[float]]"):
        return _parse_named_numbers
    if _ARRAY in annotation:
        return lambda texts, flag: tuple(parse_point(text, flag) for text in texts) or None
    return parse_numbers if "Sequence[float]" in annotation else None


def _parse_named_numbers(pairs: Sequence[str], flag: str) -> dict[str, tuple[float, ...]] | None:
    """Parse ``["a=1,2"]`` into ``{"a": (1, 2)}``, and nothing into None."""
    return {name: parse_numbers(text, flag) for name, text in parse_definitions(pairs, flag).items()} or None


def read_signature(path: str) -> Callable[..., Any]:
    """Return a function with the signature and the docstring of "MODULE:FUNCTION", and without its body.

    Of the imports of the module, only those run that its defaults and ranges use, and not those for type checkers. If
    these use names that the module defines itself, it is imported.
    """
    module, _, name = path.partition(":")
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    body = ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body
    (node,) = (n for n in body if isinstance(n, ast.FunctionDef) and n.name == name)
    node.body, node.decorator_list, node.returns = node.body[:1], [], None
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    hints = [
        a.annotation for a in arguments if a.annotation is not None and not _is_replaced(ast.unparse(a.annotation))
    ]
    parts = [*hints, *node.args.defaults, *filter(None, node.args.kw_defaults)]
    used = {n.id for part in parts for n in ast.walk(part) if isinstance(n, ast.Name)}
    imports = [n for n in body if isinstance(n, ast.ImportFrom) and used & {a.asname or a.name for a in n.names}]
    imported = {a.asname or a.name for n in imports for a in n.names}
    checked = [n for node in body if isinstance(node, ast.If) for n in node.body if isinstance(n, ast.ImportFrom)]
    of_checkers = {a.asname or a.name for n in checked for a in n.names}
    if used - imported - of_checkers - vars(builtins).keys():
        return import_function(path)
    for statement in imports:
        statement.names = [a for a in statement.names if (a.asname or a.name) in used | {"annotations"}]
    future = ast.ImportFrom("__future__", [ast.alias("annotations")], 0)
    code = ast.fix_missing_locations(ast.Module([future, *imports, node], []))
    names: dict[str, Any] = {"__name__": module, "__package__": module.rpartition(".")[0]}
    exec(compile(code, spec.origin, "exec"), names)
    return names[name]


def _is_replaced(annotation: str) -> bool:
    """Whether a parameter takes an object, in place of which the command line has a file or a name."""
    return (
        _FILE in annotation or _ARRAY in annotation or (annotation.startswith("str | ") and annotation != "str | None")
    )


def read_parameter_texts(function: Callable[..., Any]) -> dict[str, str]:
    """Return the texts of the section Parameters of a docstring, by name, each as one line.

    "As for `FUNCTION`." stands for the texts of another function of the same module.
    """
    _, _, section = (inspect.getdoc(function) or "").partition("\nParameters\n----------\n")
    entries = re.split(r"^(?=\S)", section.split("\n\n")[0], flags=re.M)
    texts: dict[str, str] = {}
    for entry in filter(None, entries):
        head, _, text = entry.partition("\n")
        text = " ".join(text.split())
        other = re.fullmatch(r"As for `(\w+)`\.", text)
        shared = read_parameter_texts(read_signature(f"{function.__module__}:{other[1]}")) if other else {}
        for name in head.partition(" : ")[0].split(", "):
            texts[name] = shared[name] if other else text
    return texts


def _find_kind(function: Callable[..., Any], name: str) -> Any:
    """Return the type of a parameter on the command line: `Path` if it may be a file, else that of the annotation."""
    annotation = str(function.__annotations__[name])
    if annotation.startswith("Literal["):  # checked by the function
        return str | None if annotation.endswith("| None") else str
    if _FILE in annotation:
        return list[Path] if re.search(rf"Sequence\[[^]]*{_FILE}", annotation) else Path
    if _ARRAY in annotation:
        return tuple[tuple[float, ...], ...] | None
    if _is_replaced(annotation):
        return str
    if "Sequence[str]" in annotation:
        return tuple[str, ...]
    names: Any = inspect.unwrap(function)
    return get_type_hints(SimpleNamespace(__annotations__={name: annotation}), names.__globals__)[name]
