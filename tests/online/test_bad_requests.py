"""Every bad request is answered by a 4xx that names the field, never by a 5xx or a NaN."""

import json

import pytest

from .conftest import error_of

SOLVE = "/scenes/toy/solve"
GOOD = {"position": [5.0, 5.0, 5.0], "pressure": 4.0}


def post(client, body, path=SOLVE, **headers):
    text = json.dumps(body) if isinstance(body, dict) else body
    return client.post(path, content=text, headers={"content-type": "application/json", **headers})


def contact(**changes):
    return {"contacts": [{**GOOD, **changes}]}


FIELDS = {
    "not json": ("{", "body"),
    "empty": ("", "body"),
    "a list": ("[]", "body"),
    "not utf-8": (b'{"contacts": "\xff"}', "body"),
    "too deep": ("[" * 5000, "body"),
    "no contacts": ({}, "contacts"),
    "empty contacts": ({"contacts": []}, "contacts"),
    "two contacts": ({"contacts": [GOOD, GOOD]}, "contacts"),
    "contacts not a list": ({"contacts": GOOD}, "contacts"),
    "contact not a table": ({"contacts": [7]}, "contacts.0"),
    "NaN pressure": ('{"contacts":[{"position":[5,5,5],"pressure":NaN}]}', "contacts.0.pressure"),
    "huge integer": (contact(pressure=10**400), "contacts.0.pressure"),
    "no pressure": ({"contacts": [{"position": [5, 5, 5]}]}, "contacts.0.pressure"),
    "negative pressure": (contact(pressure=-1.0), "contacts.0.pressure"),
    "absurd pressure": (contact(pressure=81.0), "contacts.0.pressure"),
    "text pressure": (contact(pressure="4"), "contacts.0.pressure"),
    "two coordinates": (contact(position=[5, 5]), "contacts.0.position"),
    "huge position": (contact(position=[5.0] * 9999), "contacts.0.position"),
    "far position": (contact(position=[5, 5, 9]), "contacts.0.position"),
    "very far position": (contact(position=[1e300, 5, 5]), "contacts.0.position.0"),
    "zero direction": (contact(direction=[0, 0, 0]), "contacts.0.direction"),
    "tiny direction": (contact(direction=[0, 0, -1e-200]), "contacts.0.direction"),
    "outward direction": (contact(direction=[0, 0, 1]), "contacts.0.direction"),
    "sideways direction": (contact(direction=[1, 0, 0]), "contacts.0.direction"),
    "zero radius": (contact(radius=0), "contacts.0.radius"),
    "misspelt field": ({"contacts": [{"position": [5, 5, 5], "presure": 1}]}, "contacts.0.presure"),
    "unknown key": ({**contact(), "steps": 3}, "steps"),
    "pressure twice": ('{"contacts":[{"position":[5,5,5],"pressure":1,"pressure":2}]}', "pressure"),
    "pressure twice, once escaped": (
        '{"contacts":[{"position":[5,5,5],"pressure":1,"\\u0070ressure":2}]}',
        "pressure",
    ),
    "contacts twice": (json.dumps(contact())[:-1] + "," + json.dumps(contact())[1:], "contacts"),
    "unknown output": ({**contact(), "outputs": ["strain"]}, "outputs.0"),
    "huge outputs": ({**contact(), "outputs": ["displacement"] * 999}, "outputs"),
    "unknown region": ({**contact(), "region": "left"}, "region"),
}


@pytest.mark.parametrize(("body", "field"), FIELDS.values(), ids=FIELDS)
def test_the_field_at_fault_is_named_and_check_finds_the_same_faults(client, body, field):
    solved, checked = (post(client, body, f"/scenes/toy/{verb}") for verb in ("solve", "check"))
    error = error_of(solved, 422)
    assert error["field"].startswith(field)
    assert checked.json() == solved.json()


def test_a_load_is_checked_for_its_range(client):
    for pressure, outside in ((4.0, []), (9.0, ["pressure"])):
        told = post(client, contact(pressure=pressure), "/scenes/toy/check").json()
        assert told == {
            "in_range": not outside, "out_of_range": outside, "pressure_limit": 8.0
        }  # fmt: skip


def test_what_is_allowed_is_said(client):
    assert error_of(post(client, contact(pressure=-1)), 422)["allowed"] == {"ge": 0.0}
    allowed = error_of(post(client, contact(presure=1)), 422)["allowed"]
    assert allowed == ["position", "pressure", "direction", "radius"]
    message = error_of(post(client, contact(position=[5, 5, 9])), 422)["message"]
    assert "4 mm" in message
    assert "3.0 mm" in message


def test_unknown_scene(client):
    for response in (
        post(client, contact(), "/scenes/nose/solve"),
        post(client, contact(), "/scenes/nose/check"),
        client.get("/scenes/nose"),
        client.get("/scenes/nose/mesh"),
    ):
        error = error_of(response, 404)
        assert error["field"] == "name"
        assert error["allowed"] == ["toy"]


def test_unknown_path_method_region_and_format(client):
    assert error_of(client.get("/scenes/toy/mesh?region=none"), 422)["field"] == "region"
    error = error_of(post(client, contact(), accept="text/html"), 406)
    assert error["field"] == "accept"
    assert "application/json" in error["allowed"]
    assert error_of(client.get("/nowhere"), 404)["field"] == "path"
    response = client.get(SOLVE)
    assert error_of(response, 405)["allowed"] == ["POST"]
    assert response.headers["allow"] == "POST"


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_a_body_that_does_not_claim_to_be_json(client, kind):
    response = client.post(SOLVE, content=json.dumps(contact()), headers={"content-type": kind})
    assert error_of(response, 415)["field"] == "content-type"


@pytest.mark.parametrize("declared", [True, False])
def test_a_body_too_large(client, declared):
    text = json.dumps(contact(position=[5.0] * 20_000)).encode()
    body = text if declared else iter([text[:70_000], text[70_000:]])  # chunked
    error = error_of(post(client, body), 413)
    assert error["field"] == "body"
    assert error["allowed"] == {"max_bytes": 65536}
