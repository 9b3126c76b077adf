"""Histories over HTTP: the model's own answers, step by step, or refusals that name the field."""

import numpy as np
import pytest

from palpate.online.serve import layout
from palpate.online.serve.schemas import MOST_STEPS
from palpate.online.serve.wire import BINARY
from palpate.shared.reduced.transfer import REST

from ..conftest import error_of

CONTACT = {"position": [5.0, 5.0, 8.0], "pressure": 2.0}
STEPS = [
    {"time": 0.05, "contact": CONTACT},
    {"time": 0.5, "contact": CONTACT},
    {"time": 0.5, "contact": None},
    {"time": 0.8},
]


@pytest.fixture
def ask(serve, visco_atlas):
    """Return a function that posts a history to the visco-elastic scene."""
    with serve(visco_atlas) as client:

        def ask(steps=STEPS, accept="application/json", **options):
            document, headers = {"steps": steps, **options}, {"accept": accept}
            return client.post(
                f"/scenes/{visco_atlas.name}/history", json=document, headers=headers
            )

        yield ask


def test_steps_are_those_of_the_atlas(ask, visco_atlas):
    answered = ask().json()
    past, warm = REST, visco_atlas.new_warm()
    assert answered["scene"] == visco_atlas.name
    for step, pressure, dt in zip(
        answered["steps"], (2.0, 2.0, 0.0, 0.0), (0.05, 0.45, 0.0, 0.3), strict=True
    ):
        moment = visco_atlas.press(CONTACT["position"], pressure, past=past, dt=dt, warm=warm)
        past = moment.past
        np.testing.assert_allclose(
            step["contact_displacement"], moment.contact_displacement, rtol=1e-6, atol=1e-9
        )
        assert step["trust"]["converged"]
        told = step["trust"]["error_estimate"]
        assert told["displacement"] == pytest.approx(moment.error_displacement)
        assert told["von_mises"] == pytest.approx(moment.error_von_mises)
        assert step["contact"]["pressure"] == pressure
        assert step["time"] == pytest.approx(moment.time)
    pressed, held, released, rested = (s["contact_displacement"][2] for s in answered["steps"])
    assert held < pressed < released < rested < 0.0
    _, fields = layout.decode(ask(accept=BINARY, region="all").content)  # of the end
    np.testing.assert_allclose(fields["displacement"], visco_atlas.displacement(moment), atol=1e-6)
    assert fields["von_mises"].shape == (len(visco_atlas.nodes),)


def changed(number, **values):
    steps = [dict(step) for step in STEPS]
    steps[number] |= values
    return steps


@pytest.mark.parametrize(
    ("steps", "field"),
    [
        ([], "steps"),
        (STEPS * (MOST_STEPS // len(STEPS) + 1), "steps"),
        (changed(1, time=-1.0), "steps.1.time"),
        (changed(1, time=0.01), "steps"),
        (changed(1, tiem=0.01), "steps.1.tiem"),
        (changed(1, contact={**CONTACT, "pressure": -1.0}), "steps.1.contact.pressure"),
        (changed(1, contact={**CONTACT, "pressure": 900.0}), "steps.1.contact.pressure"),
        (changed(1, contact={**CONTACT, "position": [0, 0, 99.0]}), "steps.1.contact.position"),
    ],
)
def test_what_is_wrong_is_named(ask, steps, field):
    assert error_of(ask(steps), 422)["field"] == field


def test_elastic_scenes_refuse(client):
    response = client.post("/scenes/toy/history", json={"steps": STEPS})
    assert error_of(response, 404)["code"] == "no_time"
