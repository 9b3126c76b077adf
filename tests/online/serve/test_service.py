import logging

import pytest

from palpate.online.serve.errors import Refusal
from palpate.shared.errors import PalpateError

from ..fake_model import FakeModel


def ignore(model):
    pass


def test_what_fails_is_named_and_the_others_are_served(fake_service, caplog):
    caplog.set_level(logging.INFO)
    models = {
        "bug": KeyError("basis"),
        "foreign": PalpateError("foreign.h5: not an artifact"),
        "toy": FakeModel(),
    }
    service = fake_service(**models)
    service.open(ignore)
    assert list(service.models) == ["toy"]
    reasons = {refused["file"]: refused["reason"] for refused in service.refused}
    assert reasons["foreign.h5"] == "foreign.h5: not an artifact"
    assert "KeyError" in reasons["bug.h5"]
    for file in ("foreign.h5", "bug.h5", "toy.h5"):
        assert file in caplog.text


def test_a_name_is_served_once(fake_service):
    service = fake_service(first=FakeModel("toy"), second=FakeModel("toy"))
    service.open(ignore)
    assert [refused["file"] for refused in service.refused] == ["second.h5"]
    assert "another file already holds 'toy'" in service.refused[0]["reason"]


def test_nothing_is_given_out_before_all_are_ready(fake_service):
    service = fake_service(toy=FakeModel())
    service.open(ignore)
    with pytest.raises(Refusal, match="being loaded"):
        service.model("toy")
    service.ready.set()
    assert service.model("toy").model.name == "toy"


def test_a_model_that_fails_its_first_answers_is_refused(fake_service):
    def warm(model):
        raise Refusal("no_equilibrium", "contacts.0.pressure", "The answer is not finite")

    service = fake_service(toy=FakeModel())
    service.open(warm)
    assert "not finite" in service.refused[0]["reason"]
