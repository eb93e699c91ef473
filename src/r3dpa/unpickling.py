"""Pickles from elsewhere: nothing but arrays is loaded, and what their readers may raise."""

from __future__ import annotations

import pickle
import struct
from collections.abc import Mapping
from typing import IO, Any

__all__ = ["UNPICKLING_ERRORS", "ArraysOnly"]

#: Of ``torch.load`` and of restricted unpicklers, on bytes cut off, exchanged, or not accepted.
UNPICKLING_ERRORS = (
    pickle.UnpicklingError,
    struct.error,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    OverflowError,
    RuntimeError,
    TypeError,
    ValueError,
)


class ArraysOnly(pickle.Unpickler):
    """Unpickler that knows no classes or functions but those it is given.

    Args:
        file: Open for reading.
        known: What module and name in the file stand for.
    """

    def __init__(self, file: IO[bytes], known: Mapping[tuple[str, str], Any]) -> None:
        super().__init__(file)
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        """One of those known.

        Raises:
            pickle.UnpicklingError: If it is another one.
        """
        if (module, name) not in self._known:
            raise pickle.UnpicklingError(f"{module}.{name} is no array; it is not loaded")
        return self._known[module, name]
