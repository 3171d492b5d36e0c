"""Commands from the signatures of functions: arguments, options, ranges, defaults and help texts.

A signature is read from the source, so that help and completion do not import what the function computes with.
"""

from __future__ import annotations

import ast
import builtins
import importlib.util
import inspect
import re
from collections.abc import Callable
from dataclasses import Field, fields, is_dataclass, make_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

from nerg_mi.errors import NergError, parameter
from nerg_mi.options import MAIN, OUTPUT, TRAINING, cpu_threads, llvm_variant, option
from nerg_mi.progress import Reporter
from nerg_mi.ranges import RANGE, find_ranges
from nerg_mi.workflows.base import Command, argument, extra, import_function, out, select_backend

from .table import Row

_FILE = "FilePath"
"""Part of the annotation of parameters that may be files."""

_EMPTY = inspect.Parameter.empty
_DEVICE = {"threads": ("int | None", cpu_threads()), "mode": ("str", llvm_variant())}


def make_command(row: Row) -> Command:
    """Return the command of a ``row``."""
    function = read_signature(row.function)
    parameters = inspect.signature(function).parameters
    flags = {name: f"--{next(iter(row.alternatives.get(name, [name]))).replace('_', '-')}" for name in parameters}
    texts = {
        name: re.sub("``(\\w+)``", lambda m: flags.get(m[1], m[1]), text)
        for name, text in read_parameter_texts(function).items()
    }
    kinds = {name: _find_kind(function, name) for name in parameters if name != "progress"}
    arguments = {
        name: argument(texts[name], kinds[name], required=parameters[name].default is _EMPTY) for name in row.arguments
    }
    writes, outputs = "output" in parameters, dict[str, Any]()
    if writes:
        is_required = row.output or parameters["output"].default is _EMPTY
        arguments["output"] = out(row.output or texts["output"], default=... if is_required else None)
    elif row.output:
        outputs["output"] = out(row.output, default=None if row.suffices else ...)
    for name, (help, *spellings) in row.more_outputs.items():
        outputs[name] = extra(None, help, Path, *(spellings or [f"--{name}"]), group=OUTPUT)
    arguments |= outputs
    members, settings, ranges = list[Any](), dict[str, Any](), find_ranges(function)
    for name in (name for name in kinds if name not in arguments):
        default = parameters[name].default
        if name in row.alternatives:
            files = row.alternatives[name].items()
            members += [(file, Path | None, option(None, help, group=MAIN)) for file, help in files]
        elif is_dataclass(default):
            settings[name] = type(default)
            members += [(f.name, f.type, _repeat(f)) for f in fields(default) if "help" in f.metadata]
        else:
            names = row.spellings.get(name, ())
            made = option(default, texts[name], *names, within=ranges.get(name), group=MAIN)
            members.append((name, kinds[name], made))
    members += [(name, *declared) for name, declared in _DEVICE.items() if row.computes]
    options = make_dataclass("Options", members, frozen=True, kw_only=True)

    def run(*, options: Any, reporter: Reporter, **values: Any) -> None:
        paths = {name: path for name in outputs if (path := values.pop(name)) is not None}
        if row.suffices and not paths:
            raise NergError(f"no output is given: add {' or '.join(parameter(name, 'FILE') for name in outputs)}")
        for path in paths.values():
            from nerg_mi.files.atomic import check_writable  # which imports NumPy

            check_writable(path, *row.suffixes)
        if row.computes:
            select_backend(options.mode, options.threads)
        chosen = {name: getattr(options, name) for name in kinds if hasattr(options, name)}
        for name, kind in settings.items():
            shown = [f.name for f in fields(kind) if hasattr(options, f.name)]
            chosen[name] = kind(**{field: getattr(options, field) for field in shown})
        for name, files in row.alternatives.items():
            choices = {parameter(file): path for file in files if (path := getattr(options, file)) is not None}
            if len(choices) > 1:
                raise NergError(f"{' and '.join(choices)} are alternatives: give one of them")
            chosen[name] = next(iter(choices.values()), None)
        chosen |= {name: name in paths for name in row.more_outputs if name in kinds}
        result = import_function(row.function)(**values, **chosen, progress=reporter)
        if paths:
            result.save(paths.get("output"), **{name: paths[name] for name in row.more_outputs if name in paths})
        for path in paths.values():
            reporter.message(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")

    summary, _, more = (inspect.getdoc(function) or "").partition("\n\nParameters\n")[0].partition("\n\n")
    return Command(row.name, run, " ".join(summary.split()), " ".join(more.split()), options, (), None, arguments)


def _repeat(setting: Field[Any]) -> Any:
    """Return the option of a field of settings."""
    return option(setting.default, setting.metadata["help"], within=setting.metadata[RANGE], group=TRAINING)


def read_signature(path: str) -> Callable[..., Any]:
    """Return a function with the signature and the docstring of "MODULE:FUNCTION", and without its body.

    Of the imports of the module, only those run that its defaults and ranges use. If these use names that the module
    defines itself, it is imported.
    """
    module, _, name = path.partition(":")
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    body = ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body
    (node,) = (n for n in body if isinstance(n, ast.FunctionDef) and n.name == name)
    node.body, node.decorator_list, node.returns = node.body[:1], [], None
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    hints = [a.annotation for a in arguments if a.annotation is not None and _FILE not in ast.unparse(a.annotation)]
    parts = [*hints, *node.args.defaults, *filter(None, node.args.kw_defaults)]
    used = {n.id for part in parts for n in ast.walk(part) if isinstance(n, ast.Name)}
    imports = [n for n in body if isinstance(n, ast.ImportFrom) and used & {a.asname or a.name for a in n.names}]
    imported = {a.asname or a.name for n in imports for a in n.names}
    if used - imported - vars(builtins).keys():
        return import_function(path)
    for statement in imports:
        statement.names = [a for a in statement.names if (a.asname or a.name) in used | {"annotations"}]
    future = ast.ImportFrom("__future__", [ast.alias("annotations")], 0)
    code = ast.fix_missing_locations(ast.Module([future, *imports, node], []))
    names: dict[str, Any] = {"__name__": module, "__package__": module.rpartition(".")[0]}
    exec(compile(code, spec.origin, "exec"), names)
    return names[name]


def read_parameter_texts(function: Callable[..., Any]) -> dict[str, str]:
    """Return the texts of the section Parameters of a docstring, by name, each as one line."""
    _, _, section = (inspect.getdoc(function) or "").partition("\nParameters\n----------\n")
    entries = re.split(r"^(?=\S)", section.split("\n\n")[0], flags=re.M)
    texts: dict[str, str] = {}
    for entry in filter(None, entries):
        head, _, text = entry.partition("\n")
        for name in head.partition(" : ")[0].split(", "):
            texts[name] = " ".join(text.split())
    return texts


def _find_kind(function: Callable[..., Any], name: str) -> Any:
    """Return the type of a parameter on the command line: `Path` if it may be a file, else that of the annotation."""
    annotation = str(function.__annotations__[name])
    if annotation.startswith("Literal["):  # checked by the function
        return str
    if _FILE in annotation:
        return list[Path] if "Sequence" in annotation else Path
    names: Any = inspect.unwrap(function)
    return get_type_hints(SimpleNamespace(__annotations__={name: annotation}), names.__globals__)[name]
