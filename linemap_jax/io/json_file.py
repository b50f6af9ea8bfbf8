"""JSON from a file, for the readers of maps and worlds."""

import json
import math
import os
from typing import Any

_MOST_DIGITS = 400  # No float has more than 309 of them before its point.


class JsonError(ValueError):
    """What is wrong with a file that should hold JSON; its name is put before it."""


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file. A mark of the byte order is passed over.

    Args:
      path: of the file.

    Returns:
      What it holds. A number beyond the floats is infinity.

    Raises:
      OSError: if the file cannot be read.
      JsonError: if it is not JSON, or holds NaN or Infinity, which JSON does not know.
    """

    def refuse(name: str) -> None:
        raise JsonError(f"holds {name}, a number that is not finite")

    def whole(digits: str) -> float:
        # Python takes a time that grows with the square of their number, and from some length on refuses.
        return int(digits) if len(digits) < _MOST_DIGITS else math.copysign(math.inf, -1 if digits[0] == "-" else 1)

    try:
        with open(path, encoding="utf-8-sig") as file:
            return json.load(file, parse_constant=refuse, parse_int=whole)
    except json.JSONDecodeError as error:
        raise JsonError(f"line {error.lineno} is not JSON: {error.msg}") from None
    except (UnicodeDecodeError, RecursionError):
        raise JsonError("is not JSON") from None
