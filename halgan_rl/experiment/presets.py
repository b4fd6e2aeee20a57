"""Presets: several instances of one configuration, chosen by one flag, changed by the others."""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import tyro

Config = TypeVar("Config")


def parse_config(
    presets: Mapping[str, Config], args: Sequence[str] | None = None, *, description: str | None
) -> Config:
    """Reads a command line: ``--preset`` chooses the defaults of all other flags.

    Args:
        presets: configurations (dataclasses with a field ``preset``) by name; the first is the default.
        args: the command line; None is that of the process.
        description: what ``--help`` says first.

    Raises:
        SystemExit: for ``--help``, and, after a message, for a flag or a value that does not exist.

    Examples:
        >>> import dataclasses
        >>> @dataclasses.dataclass(frozen=True)
        ... class Settings:
        ...     preset: str = "default"
        ...     batch_size: int = 64
        >>> presets = {"default": Settings(), "paper": Settings("paper", 32)}
        >>> parse_config(presets, ["--preset", "paper"], description=None)
        Settings(preset='paper', batch_size=32)
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--preset", choices=presets, default=next(iter(presets)))
    chosen = parser.parse_known_args(args)[0].preset
    return tyro.cli(type(presets[chosen]), args=args, default=presets[chosen], description=description)


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """Returns a nested configuration with some values changed.

    Args:
        config: a dataclass, whose fields may be dataclasses.
        changes: new values by their names on the command line, ``{"agent.tau": 0.1}``.

    Raises:
        AttributeError: if there is no such field.
    """
    values: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        first, _, rest = name.partition(".")
        if rest:
            inner.setdefault(first, {})[rest] = value
        else:
            values[first] = value
    values |= {first: changed(getattr(config, first), nested) for first, nested in inner.items()}
    return dataclasses.replace(config, **values)  # type: ignore[type-var]  # all at once: they are checked together
