"""Pickles from elsewhere: nothing but arrays is loaded, and what their readers may raise.

Arrays alone can do harm, too: a few bytes may ask for terabytes, or for a type whose parts lie
outside its memory. The unpickler in Python is used, slower by opcode but not by array: the one in C
allocates whatever the file asks for before it looks at how long the file is.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
from collections.abc import Callable, Mapping
from typing import IO, Any, ClassVar

import numpy as np

__all__ = ["ArraysOnly", "array_header"]


def array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether in Fortran order, and type of an array in NumPy's format.

    Raises:
        ValueError: If it is none; or another of :data:`UNPICKLING_ERRORS`.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read = np.lib.format.read_array_header_2_0
        length = stream.read(4)  # which NumPy allocates before it looks how much there is
        if len(length) < 4 or (size := struct.unpack("<I", length)[0]) > _MOST_IN_LINE:
            raise ValueError("the head is cut off or longer than that of any array of numbers")
        stream = io.BytesIO(length + stream.read(size))
    shape, fortran, dtype = read(stream)
    if min(shape, default=0) < 0 or dtype.itemsize < 1:
        raise ValueError(f"an array {shape} of {dtype} makes no sense")
    return shape, fortran, dtype


class _Bounded:
    """A stream that is never asked for more bytes than it still holds."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        position = file.tell()
        self._size = file.seek(0, os.SEEK_END)
        file.seek(position)

    def read(self, count: int) -> bytes:
        """So many bytes.

        Raises:
            EOFError: If there are fewer.
        """
        left = self._size - self._file.tell()
        if not 0 <= count <= left:
            raise EOFError(f"asks for {count} bytes where {left} are left")
        return self._file.read(count)

    def readline(self) -> bytes:
        """Bytes to the next line break, at most a few thousand."""
        return self._file.readline(_MOST_IN_LINE)


_MOST_IN_LINE = 4096
_SIZES_OF_TYPE = (3, None, None, None, -1, -1)  # state of a dtype of single numbers: no fields


class ArraysOnly(pickle._Unpickler):
    """Unpickler that knows no classes or functions but those it is given, and NumPy's arrays.

    Args:
        file: Open for reading, with a position that can be changed.
        known: What module and name in the file stand for, beside those of arrays.
    """

    stack: list[Any]
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def __init__(self, file: IO[bytes], known: Mapping[tuple[str, str], Any] | None = None) -> None:
        super().__init__(_Bounded(file))
        self._known = {**_ARRAYS, **(known or {})}

    def find_class(self, module: str, name: str) -> Any:
        """One of those known.

        Raises:
            pickle.UnpicklingError: If it is another one.
        """
        if (module, name) not in self._known:
            raise pickle.UnpicklingError(f"{module}.{name} is no array; it is not loaded")
        return self._known[module, name]

    def load_build(self) -> None:
        """State of the object below it, of a type only if it is one of single numbers.

        Raises:
            pickle.UnpicklingError: If it is of another type.
        """
        state, built = self.stack[-1], self.stack[-2]
        if isinstance(built, np.dtype):
            plain = isinstance(state, tuple) and len(state) == 8
            if not plain or (state[0], *state[2:7]) != _SIZES_OF_TYPE:
                raise pickle.UnpicklingError(
                    f"a type with parts or sizes of its own: {state!r:.80}"
                )
        _load_build(self)

    dispatch[pickle.BUILD[0]] = load_build
    del dispatch[pickle.BYTEARRAY8[0]]  # allocates what it is told to; NumPy writes none


_load_build: Callable[[Any], None] = pickle._Unpickler.dispatch[pickle.BUILD[0]]


def _empty(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """The array without elements that NumPy begins with; its state brings shape and numbers."""
    if kind is not np.ndarray or shape != (0,) or code not in (b"b", "b"):
        raise pickle.UnpicklingError(f"an array that begins with {shape!r:.80} of {code!r:.20}")
    return np.empty(0, np.int8)


def _type(code: str, align: bool = False, copy: bool = False) -> np.dtype:
    """A type of single numbers, or of objects."""
    if not isinstance(code, str) or code not in _TYPE_CODES:
        raise pickle.UnpicklingError(f"a type that is none of single numbers: {code!r:.80}")
    return np.dtype(code, align, True)


_TYPE_CODES = {"b1", "O", "O8", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8))}
_TYPE_CODES |= {"f2", "f4", "f8"}
#: What a pickle of arrays needs, as NumPy 1 and 2 call it.
_ARRAYS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): _type,
    **{
        (f"numpy.{core}.multiarray", name): function
        for core in ("core", "_core")
        for name, function in (
            ("_reconstruct", _empty),
            ("scalar", np.float64(0).__reduce__()[0]),
        )
    },
}
