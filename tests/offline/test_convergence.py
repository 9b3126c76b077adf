"""Orders of convergence of references on graded meshes."""

from palpate.offline.fem.graded import Grading
from palpate.offline.scenes import find_scene
from palpate.offline.studies.convergence import convergence


def test_references_converge_from_both_sides_and_say_the_same(tmp_path):
    found = convergence(find_scene("quick"), 1, tmp_path, Grading(0.5, 0.5, 0.9, 2.0, 0.2))
    for own in found.values():
        assert own["compliance_order"] > 0.8
        assert own["von_mises_order"] > 0.8
        assert own["compliance_error"] < 0.02
        assert own["von_mises_error"] < 0.2
    header, two, three = (tmp_path / "convergence.csv").read_text().splitlines()
    column = header.split(",").index("finest_compliance")
    one, other = (float(row.split(",")[column]) for row in (two, three))
    assert other < one < 1.01 * other
