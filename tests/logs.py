"""Reading logs whole, and having them refused, for the tests of the readers."""

from typing import Any

import pytest

from linemap_jax.io.log import open_log
from linemap_jax.io.reading import LogError, Notes, Reading


def read(path: Any, **options: Any) -> tuple[list[Reading], Notes]:
    """All of a log, and what was noticed on the way."""
    log = open_log(path, **options)
    return list(log), log.notes


def refused(path: Any, **options: Any) -> str:
    """The sentence with which a log is refused; it names the file and is one line."""
    with pytest.raises(LogError) as caught:
        list(open_log(path, **options))
    sentence = str(caught.value)
    assert str(path) in sentence
    assert "\n" not in sentence
    return sentence
