"""Meshes with nodal fields as VTK's XML files (.vtu), which ParaView and its kin read.

Format: VTK file formats, https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html
"""

from __future__ import annotations

import sys
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

CELL_TYPES = {8: 12, 20: 25}  # VTK_HEXAHEDRON and VTK_QUADRATIC_HEXAHEDRON, by nodes per element
TYPE_NAMES = {"f": "Float64", "i": "Int64", "u": "UInt8"}


def write_vtu(
    path: Path,
    nodes: NDArray[np.float64],
    elements: NDArray[np.integer[Any]],
    point_data: Mapping[str, NDArray[Any]],
) -> None:
    """Write a mesh of hexahedra (e, 8) or (e, 20) and fields (n,) or (n, k) on its nodes (n, 3).

    Floats are written with 8 bytes, truth values as 0 and 1.
    """
    count, size = elements.shape
    order = "LittleEndian" if sys.byteorder == "little" else "BigEndian"
    root = ET.Element(
        "VTKFile", type="UnstructuredGrid", version="1.0", byte_order=order, header_type="UInt64"
    )
    grid = ET.SubElement(root, "UnstructuredGrid")
    piece = ET.SubElement(grid, "Piece", NumberOfPoints=str(len(nodes)), NumberOfCells=str(count))
    _add(ET.SubElement(piece, "Points"), "points", nodes)
    cells = ET.SubElement(piece, "Cells")
    _add(cells, "connectivity", elements.ravel())
    _add(cells, "offsets", size * np.arange(1, count + 1))
    _add(cells, "types", np.full(count, CELL_TYPES[size], np.uint8))
    fields = ET.SubElement(piece, "PointData")
    for name, values in point_data.items():
        _add(fields, name, values)
    path.parent.mkdir(parents=True, exist_ok=True)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _add(parent: ET.Element, name: str, values: NDArray[Any]) -> None:
    kind = values.dtype.kind.replace("b", "u")
    data = np.ascontiguousarray(values, dtype=TYPE_NAMES[kind].lower()).tobytes()
    element = ET.SubElement(parent, "DataArray", type=TYPE_NAMES[kind], Name=name, format="binary")
    if values.ndim == 2:
        element.set("NumberOfComponents", str(values.shape[1]))
    # the length of the data goes before them, into the same base64
    element.text = b64encode(np.uint64(len(data)).tobytes() + data).decode()
