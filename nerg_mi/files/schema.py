"""Structure of JSON documents, declared once for each format and checked before values are used.

A schema is one of:

- ``str``, ``bool``, ``dict`` or ``list``: any value of this type,
- a `Number`,
- ``Items(schema)``: a list of values of a schema; ``Names(schema)``: an object with any keys and such values,
- a dict: an object with these keys; a key that ends in "?" may be missing, and further keys are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from nerg_mi.errors import sanitize

_TYPE_NAMES = {str: "a text", bool: "true or false", dict: "an object", list: "a list"}


@dataclass(frozen=True)
class Number:
    """A number in ``low`` .. ``high``, which is not NaN; with ``is_integer``, a whole number without decimals."""

    low: float = -1e308
    high: float = 1e308
    is_integer: bool = False


@dataclass(frozen=True)
class Items:
    """A list of ``low`` to ``high`` values of ``schema``."""

    schema: Any
    low: int = 0
    high: int = 1 << 62


@dataclass(frozen=True)
class Names:
    """An object whose values have the schema ``schema``, under any keys."""

    schema: Any


NUMBER = Number()
INDEX = Number(0, is_integer=True)


def check_json(value: Any, schema: Any, name: str = "") -> Any:
    """Return ``value`` if it has the structure ``schema``.

    Parameters
    ----------
    value
        Parsed JSON.
    schema
        See the module.
    name
        Where the value is, in messages; "" for the document.

    Raises
    ------
    ValueError
        With the first key whose value is missing or different, its value, and what it must be.
    """
    error = next(_iter_errors(value, schema, name), None)
    if error:
        raise ValueError(error)
    return value


def _iter_errors(value: Any, schema: Any, name: str) -> Iterator[str]:
    if not _has_type(value, schema):
        subject = f'"{sanitize(name, 100)}"' if name else "its JSON document"
        yield f"{subject} must be {_describe(schema)}, got {_show(value)}"
        return
    if isinstance(schema, Items):
        for k, item in enumerate(value):
            yield from _iter_errors(item, schema.schema, f"{name}[{k}]")
    elif isinstance(schema, Names):
        for key, item in value.items():
            yield from _iter_errors(item, schema.schema, _join(name, key))
    elif isinstance(schema, Mapping):
        for key, part in schema.items():
            key, is_optional = key.removesuffix("?"), key.endswith("?")
            if key in value:
                yield from _iter_errors(value[key], part, _join(name, key))
            elif not is_optional:
                yield f'it lacks "{sanitize(_join(name, key), 100)}"'


def _join(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def _has_type(value: Any, schema: Any) -> bool:
    if isinstance(schema, Number):
        types = int if schema.is_integer else (int, float)
        return isinstance(value, types) and not isinstance(value, bool) and schema.low <= value <= schema.high
    if isinstance(schema, Items):
        return isinstance(value, list) and schema.low <= len(value) <= schema.high
    return isinstance(value, dict if isinstance(schema, (Names, Mapping)) else schema)


def _describe(schema: Any, plural: bool = False) -> str:
    if isinstance(schema, Number):
        kind = "whole number" if schema.is_integer else "number"
        limits = f" of at least {schema.low:,.15g}" if schema.low > -1e300 else ""
        if schema.high < 1e300:
            limits = f" of {schema.low:,.15g} to {schema.high:,.15g}"
        return (f"{kind}s" if plural else f"a {kind}") + limits
    if isinstance(schema, Items):
        size = f"{schema.low:,}" + ("" if schema.low == schema.high else f" to {schema.high:,}")
        items = _describe(schema.schema, plural=True)
        return ("lists" if plural else "a list") + f" of {items if schema.high >= 1 << 62 else f'{size} {items}'}"
    if isinstance(schema, (Names, Mapping)):
        return "objects" if plural else "an object"
    return "texts" if plural and schema is str else _TYPE_NAMES[schema]


def _show(value: Any) -> str:
    if isinstance(value, (dict, list)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value):,}"
    names = {None: "null", True: "true", False: "false"}
    if value is None or isinstance(value, bool):
        return names[value]
    return f'"{sanitize(value, 40)}"' if isinstance(value, str) else sanitize(value, 40)
