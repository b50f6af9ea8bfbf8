"""A stream of unknown length in a list of bounded length."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

from numpy.typing import NDArray

T = TypeVar("T")


class Thinned(Generic[T]):
    """Keeps every n-th item of a stream, from the first on, with n doubled whenever there would be too many.

    Attributes:
      kept: the items, `most` at most.
      every: n.
    """

    def __init__(self, most: int) -> None:
        """Nothing yet; `most` items will be kept at most."""
        self.kept: list[T] = []
        self.every = 1
        self._most, self._seen = most, 0

    def extend(self, items: Sequence[T] | NDArray[Any]) -> None:
        """The next items of the stream."""
        self.kept.extend(items[-self._seen % self.every :: self.every])
        self._seen += len(items)
        while len(self.kept) > self._most:
            self.kept = self.kept[::2]
            self.every *= 2
