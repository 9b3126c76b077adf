"""A body from a file is trained as others are: its mesh chosen, its answers those of the model."""

import numpy as np
import pytest

from palpate.offline.choose.mesh import with_mesh
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.info import info, lines
from palpate.offline.scenes import find_scene
from palpate.offline.train import train
from palpate.shared.model import ReducedModel

from .conftest import SCENE, bricks
from .test_mesh_file import tetrahedra, written

BOX = """
tolerance.displacement = 0.2
tolerance.von_mises = 0.5
support.z = [-0.1, 0.1]
surface.z = [7.9, 8.1]
training.samples = 60
training.size.patch_spacing = 4.0
training.size.modes = 48
training.size.cubature_points = 64
training.size.region_modes = 120
[[tissue.region]]
name = "core"
young = 150.0
poisson = 0.45
x = [4.0, 8.0]
y = [4.0, 8.0]
z = [0.0, 4.0]
[geometry]
kind = "mesh"
file = "box.vtu"
unit = "mm"
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Return the file of a scene whose body is a mesh in a file."""
    folder = tmp_path_factory.mktemp("box")
    points, cells = bricks((3, 3, 2), (12.0, 12.0, 8.0))
    written(folder / "box.vtu", points, [("tetra", tetrahedra(points, cells))])
    body = SCENE.replace('"body"', '"box"')
    (folder / "box.toml").write_text(body.replace("0.15", "0.12") + BOX)
    return folder / "box.toml"


@pytest.fixture(scope="module")
def model(file):
    """Return the reduced model of that body."""
    return ReducedModel.load(train(file, file.with_name("box.h5"), workers=1))


def test_its_mesh_is_the_coarsest_that_leaves_the_reduction_its_share(file, model):
    scene = find_scene(file)
    chosen, document = with_mesh(scene)
    *_, last = document["tried"]
    assert model.scene.geometry.finest == chosen.geometry.finest == last["finest"]
    assert len(model.body.nodes) * 3 == last["dofs"]
    assert model.body.elements.shape[1] == 10
    within = zip(last["errors"].values(), scene.tolerance.mesh, strict=True)
    assert all(error <= most for error, most in within)


def test_its_answers_are_those_of_the_full_model(file, model):
    problem = FullProblem(model.scene, FullProblem.of_artifact(file.with_name("box.h5")).mesh)
    for x in model.models.centres[:4]:
        limit = model.press(x, 0.0).pressure_limit
        answer = model.press(x, 0.7 * limit)
        x, normal, _ = model.surface.project(x)
        exact = problem.solve(Load(x, -normal, 0.7 * limit)).displacement
        error = np.linalg.norm(model.displacement(answer) - exact) / np.linalg.norm(exact)
        assert answer.converged
        assert answer.in_range
        assert error < 0.03
        assert error < answer.error_displacement
    assert model.info["validation"]["displacement"]["p95"] < 0.03


def test_info_says_what_is_known_of_the_body(file, model):
    found = info(file.with_name("box.h5"))
    assert found["training"]["file"]["components"] == 1
    assert found["training"]["file"]["quality"]["volume_mm3"] == pytest.approx(12 * 12 * 8)
    said = [line.split()[0] for line in lines(found)]
    assert {"volume", "elements", "thickness"} < set(said)
    assert "core 10 times as stiff" in "\n".join(lines(found))


def test_it_tells_the_stress_of_its_regions(file, model):
    assert 0 < np.sum(model.body.region == 1) < 0.2 * len(model.body.region)
    x = model.models.centres[0]
    answer = model.press(x, 0.7 * model.press(x, 0.0).pressure_limit)
    u = model.displacement(answer)
    found = model.peak(answer, u)
    field = FullProblem.of_artifact(file.with_name("box.h5")).stress_field
    exact = field.peaks_by_region(u.astype(float), None, answer.footprint)
    told = [found, found["regions"]["core"]]
    for (largest, high), own in zip(exact, told, strict=True):
        assert own["von_mises"] == pytest.approx(largest, rel=1e-3)
        assert own["von_mises_p99"] == pytest.approx(high, rel=1e-3)
