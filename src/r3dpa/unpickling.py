"""What a file that is no pickle, or a damaged one, makes its reader raise."""

from __future__ import annotations

import pickle
import struct

__all__ = ["UNPICKLING_ERRORS"]

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
