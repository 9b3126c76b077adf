import meshio
import numpy as np
import pytest

from palpate.offline.vtu import write_vtu
from palpate.shared.geometry.elements import HEX20_NODES, HEX_CORNERS


@pytest.mark.parametrize(
    ("reference", "kind"), [(HEX_CORNERS, "hexahedron"), (HEX20_NODES, "hexahedron20")]
)
def test_what_is_written_is_read_by_others(tmp_path, rng, reference, kind):
    nodes = np.vstack([reference, reference + np.array([2.0, 0.0, 0.0])])
    elements = np.arange(len(nodes), dtype=np.int32).reshape(2, -1)
    fields = {
        "displacement": rng.random(nodes.shape).astype(np.float32),
        "von_mises": rng.random(len(nodes)),
        "clamped": nodes[:, 2] < 0,
    }
    path = tmp_path / "new folder" / "mesh.vtu"
    write_vtu(path, nodes, elements, fields)
    read = meshio.read(path)
    np.testing.assert_array_equal(read.points, nodes)
    assert list(read.cells_dict) == [kind]
    np.testing.assert_array_equal(read.cells_dict[kind], elements)
    assert list(read.point_data) == list(fields)
    for name, values in fields.items():
        np.testing.assert_array_equal(read.point_data[name], values)
