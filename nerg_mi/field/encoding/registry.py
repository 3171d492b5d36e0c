"""The encodings of positions that there are, by the kind that a file names and by the type of their configuration."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from .protocol import Encoding, EncodingConfig

DEFAULT_KIND = "hashgrid"
"""What a configuration in a file is of that names no kind, as no file did when there was no other."""

_CONFIGS: dict[str, type[EncodingConfig]] = {}
_ENCODINGS: dict[type[EncodingConfig], type[Encoding]] = {}


def register(config: type[EncodingConfig], encoding: type[Encoding]) -> None:
    """Let configurations of the type ``config`` stand for encodings of the type ``encoding``, in files too.

    Raises ``ValueError`` where another type has its kind.
    """
    if _CONFIGS.get(config.kind, config) is not config:
        raise ValueError(f'there is another encoding of the kind "{config.kind}": {_CONFIGS[config.kind].__name__}')
    _CONFIGS[config.kind], _ENCODINGS[config] = config, encoding


def kinds() -> tuple[str, ...]:
    """The kinds that are registered."""
    return tuple(_CONFIGS)


def config_type(about: Mapping[str, Any]) -> type[EncodingConfig]:
    """The type of configuration that the JSON object ``about`` is of. Raises ``ValueError`` for an unknown kind."""
    kind = about.get("kind", DEFAULT_KIND)
    if not isinstance(kind, str) or kind not in _CONFIGS:
        raise ValueError(
            f"its positions are encoded by {str(kind)[:40]!r}, which this version does not know; it knows "
            f"{', '.join(_CONFIGS)}"
        )
    return _CONFIGS[kind]


def encoding_config(about: Mapping[str, Any]) -> EncodingConfig:
    """The configuration that ``to_dict`` made ``about`` of. Raises ``ValueError`` or ``TypeError`` for what is none."""
    return config_type(about)(**{k: v for k, v in about.items() if k != "kind"})


def random_encoding(config: EncodingConfig, ns: ModuleType, rng: np.random.Generator) -> Encoding:
    """An untrained encoding of ``config`` on backend ``ns``."""
    return _ENCODINGS[type(config)].random(config, ns, rng)


def encoding_of(
    config: EncodingConfig, parameters: Mapping[str, Any], name: str = "grid", mode: dr.ReduceMode = dr.ReduceMode.Auto
) -> Encoding:
    """The encoding of ``config`` whose parameters stand in ``parameters`` as ``NAME.PARAMETER``; see `Encoding`."""
    arrays = {key: parameters[f"{name}.{key}"] for key in config.shapes()}
    return _ENCODINGS[type(config)](config, **arrays, mode=mode)  # pyright: ignore[reportCallIssue] as `Encoding` says
