"""Lists of loads and of positions of the tip: formats, limits, refusals, and others meanwhile."""

import threading

import numpy as np
import pytest

from palpate.online.serve import layout
from palpate.online.serve.layout import BINARY
from palpate.shared.errors import QueryError

from ..conftest import error_of
from ..fake_model import FakeModel

AT = [[5.0, 5.0, 5.0], [2.0, 3.0, 5.0]]
LOADS = {"positions": AT, "pressures": [1.0, 2.0]}


def test_json_and_binary_say_the_same(client):
    plain = client.post("/scenes/toy/solve-many", json=LOADS)
    assert plain.status_code == 200, plain.text
    body = layout.encode({}, {name: np.array(rows) for name, rows in LOADS.items()})
    headers = {"content-type": BINARY, "accept": BINARY}
    binary = client.post("/scenes/toy/solve-many", content=body, headers=headers)
    head, arrays = layout.decode(binary.content)
    assert head == {"scene": "toy"}
    for name, values in plain.json()["fields"].items():
        known = np.where(np.isinf(arrays[name]), np.nan, arrays[name])  # null in JSON
        np.testing.assert_array_equal(known, np.array(values, float))
    assert arrays["force"].dtype == np.float64
    touched = client.post("/scenes/toy/touch", json={"positions": [[5.0, 5.0, 6.5]]}).json()
    assert touched["fields"]["force"] == [[0.0, 0.0, 10.0]]


def test_where_there_is_no_error_known_there_is_null(client):
    fields = client.post("/scenes/toy/solve-many", json={**LOADS, "pressures": [1.0, 9.0]}).json()
    assert fields["fields"]["error_displacement"] == [0.001, None]


DOCUMENT = {name: np.array(rows) for name, rows in LOADS.items()}
NOWHERE = np.full((2, 3), np.nan)
WRONG = {
    "no layout": (b"x" * 100, "body"),
    "unknown array": (layout.encode({}, {**DOCUMENT, "weights": np.ones(2)}), "weights"),
    "missing array": (layout.encode({}, {"positions": np.array(AT)}), "pressures"),
    "not finite": (
        layout.encode({}, {**DOCUMENT, "positions": np.full((2, 3), np.nan)}),
        "positions",
    ),
    "too many": (layout.encode({}, {**DOCUMENT, "pressures": np.ones(20_001)}), "pressures"),
    "negative offset": (layout.encode({}, DOCUMENT).replace(b'"offset":0', b'"offset":-'), "body"),
    "huge shape": (layout.encode({}, DOCUMENT).replace(b"[2,3]", b"[9e9"), "body"),
}


@pytest.mark.parametrize(("body", "field"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_in_a_binary_list_is_named(client, body, field):
    response = client.post("/scenes/toy/solve-many", content=body, headers={"content-type": BINARY})
    assert error_of(response, 422)["field"].startswith(field)


def test_what_is_wrong_in_a_list_is_named(client):
    for changes, status, field in (
        ({"pressures": [1.0, -2.0]}, 422, "pressures"),
        ({"positions": [[5, 5, 5], [5, 5, 50]]}, 422, "position"),
        ({"positions": [AT[0]] * 5000, "pressures": [1.0] * 5000}, 422, "positions"),
        ({"contacts": []}, 422, "contacts"),
    ):
        error = error_of(client.post("/scenes/toy/solve-many", json={**LOADS, **changes}), status)
        assert error["field"].startswith(field)
    for path in ("solve-many", "touch"):
        text = client.post(f"/scenes/toy/{path}", content="1", headers={"content-type": "text/csv"})
        assert BINARY in error_of(text, 415)["allowed"]
        assert error_of(client.post(f"/scenes/no/{path}", json=LOADS), 404)


def test_a_scene_without_a_tip_says_so(serve):
    with serve(FakeModel(has_tip=False)) as client:
        response = client.post("/scenes/toy/touch", json={"positions": AT})
        assert error_of(response, 404)["code"] == "no_tip"


def test_a_list_keeps_others_waiting_for_nothing_and_is_worked_on_alone(serve):
    begun, end = threading.Event(), threading.Event()

    class Slow(FakeModel):
        slow = False

        def solve_many(self, *loads, **more):
            if not self.slow:  # while the service warms
                return super().solve_many(*loads, **more)
            begun.set()
            end.wait(10.0)
            raise QueryError("positions.3", "too slow")

    model = Slow()
    with serve(model) as client:
        model.slow = True
        first = threading.Thread(
            target=lambda: found.append(client.post("/scenes/toy/solve-many", json=LOADS))
        )
        found = []
        first.start()
        begun.wait(10.0)
        one = {"contacts": [{"position": AT[0], "pressure": 1.0}]}
        assert client.post("/scenes/toy/solve", json=one).status_code == 200
        busy = client.post("/scenes/toy/solve-many", json=LOADS)
        assert error_of(busy, 503)["code"] == "overloaded"
        assert busy.headers["retry-after"] == "1"
        end.set()
        first.join()
        assert error_of(found[0], 422)["field"] == "positions.3"
