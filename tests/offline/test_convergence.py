"""Orders of convergence of references on graded meshes."""

from palpate.offline.fem.graded import Grading
from palpate.offline.scenes import find_scene
from palpate.offline.studies.convergence import convergence


def test_references_say_the_same_with_both_integrations_and_the_finer_one_converges(tmp_path):
    found = convergence(find_scene("quick"), 1, tmp_path, Grading(0.5, 0.5, 0.9, 2.0, 0.2))
    for own in found.values():
        assert own["von_mises_order"] > 1.0
        assert own["compliance_error"] < 0.03
        assert own["von_mises_error"] < 0.2
    assert found["3x3x3"]["compliance_order"] > 1.5
    header, two, three = (tmp_path / "convergence.csv").read_text().splitlines()
    column = header.split(",").index("finest_compliance")
    one, other = (float(row.split(",")[column]) for row in (two, three))
    assert other < one < 1.01 * other  # fewer points are softer
