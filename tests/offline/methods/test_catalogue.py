"""Every method answers what it can and says when it cannot."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import Load
from palpate.offline.methods.catalogue import BUILDERS, MESHED, build
from palpate.offline.methods.method import Case
from palpate.shared.errors import PalpateError

SIZE = 18

ERRORS = {
    "modal": 0.4,
    "ritz": 0.6,
    "krylov": 0.5,
    "pod": 0.5,
    "pod-euclidean": 0.5,
    "pod, no line search": 0.5,
    "pod-ecm": 0.5,
    "pod-ecm, 1 point a mode": 0.9,
    "pod-ecsw": 0.5,
    "pod-deim": 0.5,
    "pod-gappy": 0.5,
    "ritz-at-hand": 0.1,
    "derivatives": 0.001,
    "linear": 0.4,
    "regression": 0.6,
    "full": 1e-6,
    "mass-spring": 0.5,
    "tensor-mass": 0.5,
    "artifact": 0.01,
    "artifact, warm": 0.01,
}
"""Median error that a method of this size does not exceed."""

SINGLE = {"regression", "artifact", "artifact, warm"}
"""Methods that know of one contact only."""

BLIND = {"linear", "regression", *(MESHED.keys() - {"full"})}
"""Methods that answer anything."""


@pytest.fixture(scope="module")
def methods(training):
    return {name: build(name, 1 if name in MESHED else SIZE, training) for name in ERRORS}


def test_the_list_here_is_whole():
    # the tip needs tissue that knows time
    assert ERRORS.keys() | {"artifact, tip"} == BUILDERS.keys() | MESHED.keys()


@pytest.mark.parametrize("name", ERRORS)
def test_a_method_answers_unseen_loads(methods, problem, queries, name):
    method, errors = methods[name], []
    for load, exact in queries:
        answer = method.solve(Case.of(problem, load))
        found = method.displacement(answer.state)
        assert answer.converged
        assert found.shape == exact.shape
        assert found.dtype == float
        errors.append(relative(found, exact))
    assert np.median(errors) <= ERRORS[name]


@pytest.mark.parametrize("name", ERRORS.keys() - MESHED.keys() - {"artifact", "artifact, warm"})
def test_a_method_has_the_size_asked_for(methods, name):
    assert methods[name].unknowns == SIZE


@pytest.mark.parametrize("name", ERRORS)
def test_two_contacts_are_answered_or_refused(methods, problem, queries, name):
    loads = [load for load, _ in queries[:2]]
    case, method = Case.of(problem, *loads), methods[name]
    exact = problem.model.solve(sum(problem.load_vector(load) for load in loads)).displacement
    answer = method.solve(case)
    found = method.displacement(answer.state)
    assert answer.converged == answer.trusted == (name not in SINGLE)
    if answer.converged:
        assert relative(found, exact) <= ERRORS[name]
    else:
        assert not found.any()


@pytest.mark.parametrize("name", ERRORS)
def test_no_load_is_too_much_to_say_so(methods, problem, queries, name):
    load = queries[0][0]
    case = Case.of(problem, Load(load.position, load.direction, 1e6 * load.pressure))
    answer = methods[name].solve(case)
    assert methods[name].displacement(answer.state).shape == (len(problem.mesh.nodes), 3)
    assert answer.converged == (name in BLIND)


def test_the_artifact_does_not_vouch_for_a_load_beyond_its_range(methods, problem, atlas, queries):
    load = queries[0][0]
    limit = atlas.press(load.position, load.pressure, load.direction).pressure_limit
    beyond = Load(load.position, load.direction, 1.2 * limit)
    answer = methods["artifact"].solve(Case.of(problem, beyond))
    assert answer.converged
    assert not answer.trusted


def test_a_method_is_the_same_whatever_was_built_before(training, methods, problem, queries):
    case = Case.of(problem, queries[0][0])
    again = build("pod-ecm", SIZE, replace(training))
    np.testing.assert_array_equal(again.solve(case).state, methods["pod-ecm"].solve(case).state)


def test_without_an_artifact_there_is_no_such_method(training):
    with pytest.raises(PalpateError, match="artifact"):
        build("artifact", SIZE, replace(training, atlas=None))


def test_without_the_scene_s_files_there_are_no_other_meshes(training):
    with pytest.raises(PalpateError, match="files"):
        build("full", 2, training)
