from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.online.serve.errors import Refusal
from palpate.online.serve.negotiation import BINARY, JSON, MSGPACK, OFFERED, negotiate


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        ("", JSON),
        ("*/*", JSON),
        ("application/*", JSON),
        ("application/octet-stream", BINARY),
        ("APPLICATION/MSGPACK", MSGPACK),
        ("application/octet-stream, */*", BINARY),
        ("application/json;q=0.5, application/msgpack", MSGPACK),
        ("application/json; q=0.5 , application/octet-stream;q=0.501", BINARY),
        ("application/json;q=0, */*;q=0.1", BINARY),
        ("text/html, application/xhtml+xml, */*;q=0.8", JSON),
        ("application/octet-stream;q=nan, application/msgpack;q=0.2", MSGPACK),
        ("application/json;charset=utf-8", JSON),
    ],
)
def test_the_best_liked_format_is_chosen(accept, chosen):
    assert negotiate(accept) == chosen


@pytest.mark.parametrize("accept", ["text/html", "*/*;q=0", "application/json;q=0", ";;;", "a/b,"])
def test_formats_not_on_offer_are_refused(accept):
    with pytest.raises(Refusal) as refused:
        negotiate(accept)
    assert refused.value.field == "accept"
    assert refused.value.allowed == OFFERED


@given(st.text())
def test_no_header_breaks_it(accept):
    with suppress(Refusal):
        assert negotiate(accept) in OFFERED
