"""Dataclasses of numbers as nested dictionaries, as JSON holds them, checked by annotations."""

import dataclasses
import reprlib
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from jaxtyping import jaxtyped

Kind = TypeVar("Kind")


def as_tree(of: Any, *names: str) -> dict[str, Any]:
    """Some fields, or all: arrays as nested lists, dataclasses as dictionaries."""
    names = names or tuple(field.name for field in dataclasses.fields(of))
    return {name: _plain(getattr(of, name)) for name in names}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return as_tree(value)
    return value if value is None or isinstance(value, str) else np.asarray(value).tolist()


def of_tree(kind: type[Kind], stored: Mapping[str, Any], **others: Any) -> Kind:
    """The dataclass of these fields; a missing one takes its default, further ones are ignored.

    Args:
        kind: A dataclass whose arrays are annotated with their shapes.
        stored: What `as_tree` gives.
        others: Fields that are not stored as they are.

    Raises:
        TypeError: A field without a default is missing, or one is not of its type and shape.
    """
    fields = {field.name: field.type for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    with jaxtyped("context"):  # axes of equal names have equal lengths
        values = {
            name: _of_type(name, hint, stored[name])
            for name, hint in fields.items()
            if name in stored and name not in others
        }
    return kind(**values, **others)


def _of_type(name: str, hint: Any, value: Any) -> Any:
    options: tuple[Any, ...] = typing.get_args(hint) or (hint,)
    for one in options:
        if isinstance(value, dict) and isinstance(one, type) and dataclasses.is_dataclass(one):
            return of_tree(one, value)
    found = value if value is None or isinstance(value, str) else np.asarray(value)
    if not any(isinstance(found, one) for one in options):
        raise TypeError(f"{name} is {reprlib.repr(value)}, must be {hint}")
    return found
