"""LAS and LAZ files by the package laspy."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping

import laspy
import numpy as np
from numpy.typing import NDArray

_STEP_M = 1e-4
_OWN = {"time_s": "gps_time"}
Table = NDArray[np.void]


def read(data: bytes, suffix: str) -> tuple[Table, Callable[[Table], bytes]]:
    """Return all columns of a file, x, y, z in metres, and what writes it for other rows."""
    try:
        las = laspy.read(io.BytesIO(data))
    except laspy.LaspyException as error:
        raise ValueError(error) from error
    names = [name for name in las.point_format.dimension_names if name not in ("X", "Y", "Z")]
    columns = {axis: np.array(las[axis]) for axis in "xyz"}
    columns |= {name: np.array(las[name]) for name in names}
    layout = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
    table = np.empty(len(las.points), layout)
    for name, column in columns.items():
        table[name] = column
    header = las.header

    def pack(table: Table) -> bytes:
        return _written(header, {name: table[name] for name in columns}, suffix)

    return table, pack


def las_of(columns: Mapping[str, NDArray], suffix: str) -> bytes:
    """Return the file of columns ``(P,)`` by name, x, y, z among them.

    ``time_s`` becomes the GPS time; columns that LAS does not know become extra dimensions.
    """
    header = laspy.LasHeader(point_format=7, version="1.4")  # classes up to 255
    header.scales = np.full(3, _STEP_M)
    header.offsets = np.floor([columns[axis].min() for axis in "xyz"])
    known = {*"xyz", *header.point_format.dimension_names}
    named = {_OWN.get(name, name): column for name, column in columns.items()}
    for name, column in named.items():
        if name not in known:
            try:
                dtype = column.dtype.newbyteorder("=")
                header.add_extra_dims([laspy.ExtraBytesParams(name, dtype)])
            except (laspy.LaspyException, ValueError) as error:
                raise ValueError(_no_place(name, column)) from error
    return _written(header, named, suffix)


def _written(header: laspy.LasHeader, columns: Mapping[str, NDArray], suffix: str) -> bytes:
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(columns["x"]), header=header))
    for name, column in columns.items():
        try:
            las[name] = column
        except OverflowError as error:
            raise ValueError(_no_place(name, column)) from error
        if name not in "xyz" and not np.allclose(las[name], column, equal_nan=True):
            raise ValueError(_no_place(name, column))
    stream = io.BytesIO()
    las.write(stream, do_compress=suffix == ".laz")
    return stream.getvalue()


def _no_place(name: str, column: NDArray) -> str:
    return f"column {name!r} of {column.dtype} does not fit into .las: rename or drop it"
