"""What a mistake makes of what stands there: signs, functions with a twin, and what is left alone."""

from __future__ import annotations

import ast

SIGNS = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Is: "is",
    ast.IsNot: "is not",
    ast.In: "in",
    ast.NotIn: "not in",
}
COMPARE = {"<": ">", "<=": ">=", "==": "!=", "is": "is not", "in": "not in"}
COMPARE |= {b: a for a, b in COMPARE.items()}
BOUNDARY = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}
ARITHMETIC = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "/"),
    ast.Mod: ("%", "*"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.LShift: ("<<", ">>"),
    ast.RShift: (">>", "<<"),
    ast.BitXor: ("^", "&"),
    ast.MatMult: ("@", "*"),
}
TWINS = {
    "min": "max",
    "minimum": "maximum",
    "fmin": "fmax",
    "argmin": "argmax",
    "any": "all",
    "nanmin": "nanmax",
    "sin": "cos",
    "floor": "ceil",
    "cumsum": "cumprod",
    "zeros": "ones",
    "zeros_like": "ones_like",
    "isfinite": "isnan",
    "left": "right",
}
TWINS |= {b: a for a, b in TWINS.items()}
MATHS = {"dr", "np", "math", "mi", "numpy"}
# What only decides when and where something is computed: without it values are the same.
SCHEDULING = {"eval", "schedule", "sync_thread", "make_opaque", "flush_malloc_cache"}
# A call of these is no function of its first argument that could be left out, or only converts it.
MAKERS = {
    "asarray",
    "array",
    "ascontiguousarray",
    "opaque",
    "zeros",
    "ones",
    "full",
    "empty",
    "arange",
    "linspace",
    "eye",
    "width",
    "shape",
    "ndim",
    "array_t",
    "uint32_array_t",
    "load_file",
    "load_dict",
    "traverse",
    "Log",
    "set_variant",
    "custom",
    "while_loop",
    "if_stmt",
    "scoped_set_flag",
    "make_opaque",
    "eval",
    "sync_thread",
    "schedule",
    "enable_grad",
    "hint",
    "errstate",
    "random",
    "load",
    "save",
}
UNTOUCHED_FUNCTIONS = {"__repr__", "__str__", "to_string", "name", "label"}
MESSAGE_CALLS = {"Log", "warn", "print", "log", "debug", "info", "echo"}
SMALL, LARGE = 1e-5, 1e5
