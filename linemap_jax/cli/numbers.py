"""How options that are numbers are read: what is none is told in plain words."""

import types
from typing import Any, Union, get_args, get_origin

import tyro

NUMBERS = tyro.constructors.ConstructorRegistry()
"""To be active while the options are read: `with NUMBERS:`."""


@NUMBERS.primitive_rule
def _numbers(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """One number, or so many, or none unless given."""
    kind: Any = info.type
    optional = get_origin(kind) in (Union, types.UnionType) and type(None) in get_args(kind)
    if optional:
        others = [part for part in get_args(kind) if part is not type(None)]
        kind = others[0] if len(others) == 1 else None
    parts = get_args(kind) if get_origin(kind) is tuple else (kind,)
    if not parts or len(set(parts)) > 1 or parts[0] not in (int, float):
        return None
    read, single = parts[0], get_origin(kind) is not tuple
    name = "number" if read is float else "whole number"

    def from_words(words: list[str]) -> Any:
        found = []
        for word in words:
            try:
                found.append(read(word))
            except ValueError:
                raise ValueError(f"{word!r} is not a {name}") from None
        return found[0] if single else tuple(found)

    def is_instance(value: Any) -> bool:
        if value is None:
            return optional
        values = (value,) if single else value
        # A whole number stands for any.
        return isinstance(values, tuple) and all(isinstance(x, int | read) and not isinstance(x, bool) for x in values)

    def words_of(value: Any) -> list[str]:
        return ["None"] if value is None else [str(x) for x in ((value,) if single else value)]

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=len(parts),
        metavar=" ".join([read.__name__.upper()] * len(parts)),
        instance_from_str=from_words,
        is_instance=is_instance,
        str_from_instance=words_of,
    )
