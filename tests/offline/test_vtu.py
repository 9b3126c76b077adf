import meshio
import numpy as np
import pytest

from palpate.offline.solve import write_vtu
from palpate.shared.geometry.elements import ELEMENTS


@pytest.mark.parametrize("reference", [kind.nodes for kind in ELEMENTS.values()], ids=len)
def test_what_is_written_is_read_by_others(tmp_path, rng, reference):
    nodes = np.vstack([reference, np.add(reference, [2.0, 0.0, 0.0])])
    elements = np.arange(len(nodes), dtype=np.int32).reshape(2, -1)
    fields = {
        "displacement": rng.random(nodes.shape).astype(np.float32),
        "von_mises": rng.random(len(nodes)),
        "clamped": nodes[:, 2] < 0,
    }
    write_vtu(tmp_path / "new folder" / "mesh.vtu", nodes, elements, fields)
    read = meshio.read(tmp_path / "new folder" / "mesh.vtu")
    kind = {8: "hexahedron", 20: "hexahedron20", 10: "tetra10"}[len(reference)]
    found = {"nodes": read.points, **read.cells_dict, **read.point_data}
    for name, values in {"nodes": nodes, kind: elements, **fields}.items():
        np.testing.assert_array_equal(found.pop(name), values)
    assert not found
