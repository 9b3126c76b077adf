import struct
import sys
from contextlib import suppress

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from palpate.online.serve import layout, wire
from palpate.online.serve.errors import Refusal
from palpate.online.serve.wire import BINARY, JSON, MSGPACK, OFFERED, negotiate
from palpate.shared.errors import PalpateError

HEAD = {"scene": "toy", "force": [0.0, -1.5, 2.25], "trust": {"converged": True}}
FIELDS = {
    "displacement": np.arange(6, dtype=np.float32).reshape(2, 3) / 3,
    "von_mises": np.array([1.5, np.float32(0.1)], np.float32),
}


def test_binary_is_laid_out_as_documented():
    body = wire.encode(BINARY, HEAD, FIELDS)
    magic, version, count, head_length, payload_length = struct.unpack("<4sHHII", body[:16])
    assert (magic, version, count, payload_length) == (b"PLPT", 1, 2, 32)
    assert head_length % 8 == 0
    assert len(body) == 16 + head_length + payload_length
    head = orjson.loads(body[16 : 16 + head_length])
    entry = head["arrays"][1]
    assert entry == {"name": "von_mises", "dtype": "float32", "shape": [2], "offset": 24}
    assert struct.unpack_from("<2f", body, 16 + head_length + 24) == pytest.approx((1.5, 0.1))


@given(
    arrays(np.float32, array_shapes(min_side=0, max_dims=3)),
    arrays(np.int32, array_shapes(min_side=0, max_dims=2)),
    arrays(np.uint8, array_shapes(min_side=0, max_dims=1)),
    st.text(max_size=20),
)
def test_binary_comes_back_as_it_went(floats, integers, octets, text):
    sent = {"floats": floats, "integers": integers, "octets": octets}
    head, received = layout.decode(wire.encode(BINARY, {"text": text}, sent))
    assert head == {"text": text}
    for name, array in sent.items():
        assert received[name].dtype == array.dtype
        np.testing.assert_array_equal(received[name], array)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda body: body[:10], "too few"),
        (lambda body: body[:-1], "bytes where the prefix says"),
        (lambda body: body + b"\0", "bytes where the prefix says"),
        (lambda body: b"\x89HDF" + body[4:], "wrong magic"),
        (lambda body: body[:4] + b"\x02\0" + body[6:], "layout version 2"),
        (lambda body: body[:6] + b"\x07\0" + body[8:], "2 arrays where the prefix says 7"),
    ],
)
def test_damaged_documents_are_refused(damage, message):
    with pytest.raises(PalpateError, match=message):
        layout.decode(damage(wire.encode(BINARY, HEAD, FIELDS)))


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        ("", JSON),
        ("*/*", JSON),
        ("application/*", JSON),
        ("APPLICATION/MSGPACK", MSGPACK),
        ("application/octet-stream, */*", BINARY),
        ("application/json;q=0.5, application/msgpack", MSGPACK),
        ("application/json; q=0.5 , application/octet-stream;q=0.501", BINARY),
        ("application/json;q=0, */*;q=0.1", BINARY),
        ("text/html, application/xhtml+xml, */*;q=0.8", JSON),
        ("application/octet-stream;q=nan, application/msgpack;q=0.2", MSGPACK),
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


def steps(accept):
    """Steps of the interpreter that choosing a format takes."""
    count, before = 0, sys.gettrace()

    def trace(frame, event, _):
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    sys.settrace(trace)
    try:
        with suppress(Refusal):
            negotiate.__wrapped__(accept)
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("piece", ["a/{}, ", "a/{};q=0.1,", ",", ";", "a/{};", "q={}", "*/*,", " "])
def test_a_header_ten_times_as_long_takes_at_most_ten_times_the_work(piece):
    short, long = (steps("".join(map(piece.format, range(n)))) for n in (300, 3000))
    assert 0 < long < 11 * short
