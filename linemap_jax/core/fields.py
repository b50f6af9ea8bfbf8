"""What the fields of a class mean: the strings below them, read from the source when somebody asks."""

import ast
import inspect
import textwrap
from typing import Any, TypeVar

T = TypeVar("T")


def documented(cls: type[T]) -> type[T]:
    """Let `help(cls)` show the fields of `cls`: their types, which tell the shapes, and the strings below them.

    Args:
      cls: a class with annotated fields.

    Returns:
      The same class. Its docstring has a section "Attributes:" from now on.
    """
    cls.__doc__ = _Docstring(cls.__doc__)  # pyright: ignore[reportAttributeAccessIssue]
    return cls


def meanings_of(cls: type) -> dict[str, tuple[str, str]]:
    """The fields of a class and the strings below them, which Python itself does not keep.

    Args:
      cls: a class of a file that can be read.

    Returns:
      For each annotated field, in their order, its type as it stands in the file, and its meaning in one line, empty
      where there is none.

    Raises:
      OSError: if there is no such file.
    """
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(definition, ast.ClassDef)
    body = definition.body
    meanings = {}
    for field, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else ""
            kind = ast.unparse(field.annotation).replace("' ", "'")  # jaxtyping's " K" is "K"
            meanings[field.target.id] = kind, " ".join(str(text).split())
    return meanings


class _Docstring:
    """A docstring that is completed when it is read: to read all sources on import would take a tenth of a second."""

    def __init__(self, text: str | None) -> None:
        self.text = text

    def __get__(self, instance: Any, owner: type) -> str | None:
        if self.text is None:  # as under `python -OO`
            return None
        try:
            meanings = meanings_of(owner)
        except (OSError, TypeError):  # a program without its sources
            return self.text
        fields = [
            textwrap.fill(f"{name} ({kind}): {text}", 112, initial_indent="  ", subsequent_indent="    ")
            for name, (kind, text) in meanings.items()
        ]
        return "\n".join([inspect.cleandoc(self.text), "", "Attributes:", *fields, ""])
