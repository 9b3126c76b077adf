import struct

import numpy as np
import pytest

from palpate.online.session import frames
from palpate.online.session.frames import (
    Extras,
    Flag,
    FrameError,
    Output,
    Request,
    ToolAnswer,
)
from palpate.shared.answer import Answer

REQUEST = Request(seq=7, client_time=1.5, position=(1.0, 2.0, 3.0), outputs=5)


TOUCH = Answer(
    position=np.array([1.0, 2.0, 3.0]),
    force=np.array([4.0, 5.0, 6.0]),
    tangent=np.arange(9.0).reshape(3, 3),
    energy=2.5,
    contact_point=np.array([1.0, 2.0, 1.0]),
    normal=np.array([0.0, 0.0, 1.0]),
    depth=0.5,
    depth_limit=1.5,
    error_displacement=0.001,
    error_von_mises=0.002,
    error_force=0.003,
    iterations=3,
)


def step(flags=7, **changes):
    """Return an answer of the tool, with some fields of the touch changed."""
    touch = TOUCH._replace(**changes)
    return ToolAnswer(touch, flags, steps=2, valid_radius=0.25, solve_seconds=1e-4, reason=0)


def test_the_layout_of_version_2_stays_as_it_is():
    """Clients are written against these numbers: a change of them is a new version."""
    assert frames.VERSION == 2
    assert (frames.REQUEST.itemsize, frames.REPLY.itemsize) == (40, 280)
    offsets = {name: offset for name, (_, offset) in frames.REPLY.fields.items()}
    assert (offsets["position"], offsets["force"], offsets["tangent"]) == (32, 56, 80)
    assert (offsets["valid_radius"], offsets["superseded"], offsets["outputs"]) == (164, 256, 270)
    assert (offsets["depth_limit"], offsets["reason"]) == (272, 276)
    for dtype in (frames.REQUEST, frames.REPLY):
        assert all(offset % kind.base.itemsize == 0 for kind, offset in dtype.fields.values())


def test_a_request_and_a_reply_come_back():
    assert frames.decode_request(frames.encode_request(REQUEST)) == REQUEST
    answer = step(parts=((12, 0.75, None), (3, 0.25, None)))
    frame = frames.encode_reply(REQUEST, answer, superseded=4, received=10.0, sent=10.5)
    reply = frames.decode_reply(frame)
    assert (reply.seq, reply.client_time, reply.flags) == (7, 1.5, 7)
    assert (reply.server_received, reply.server_sent, reply.superseded) == (10.0, 10.5, 4)
    np.testing.assert_array_equal(reply.position, [1, 2, 3])
    np.testing.assert_array_equal(reply.force, [4, 5, 6])
    np.testing.assert_array_equal(reply.tangent, np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(reply.contact_point, [1, 2, 1])
    np.testing.assert_array_equal(reply.model, [12, 3, -1, -1])
    np.testing.assert_array_equal(reply.weight, [0.75, 0.25, 0, 0])
    assert (reply.energy, reply.depth, reply.valid_radius) == (2.5, 0.5, 0.25)
    assert reply.solve_time == np.float32(1e-4)
    assert (reply.iterations, reply.steps, reply.nodes, reply.outputs) == (3, 2, 0, 0)
    assert (reply.depth_limit, reply.reason) == (1.5, 0)
    assert (reply.error_displacement, reply.error_force) == pytest.approx((0.001, 0.003))
    assert reply.contact
    assert reply.good
    assert reply.converged
    for flag in (Flag.CLAMPED, Flag.FALLBACK):  # a reply for another position
        assert not frames.decode_reply(frames.encode_reply(REQUEST, step(7 | flag))).good
    assert reply.coordinates is reply.displacement is reply.von_mises is None


@pytest.mark.parametrize(
    ("error", "flags", "known"),
    [
        (3e38, 7, True),
        (3.5e38, 7, False),
        (np.inf, 7, False),
        (0.001, 7 & ~Flag.IN_RANGE, False),
    ],
)
def test_errors_too_large_for_their_field_or_out_of_range_are_unknown(error, flags, known):
    answer = step(flags, error_displacement=error, error_von_mises=error, error_force=error)
    reply = frames.decode_reply(frames.encode_reply(REQUEST, answer))
    for estimate in (reply.error_displacement, reply.error_von_mises, reply.error_force):
        assert (estimate < np.inf) == known


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"outputs": 1 << 9}, "outputs"),
        ({"client_time": float("nan")}, "client_time"),
        ({"client_time": float("-inf")}, "client_time"),
        ({"position": (float("nan"), 0.0, 0.0)}, "position"),
        ({"position": (0.0, float("inf"), 0.0)}, "position"),
        ({"position": (0.0, 0.0, -1.1e4)}, "position"),
    ],
)
def test_nonsense_names_the_field(change, field):
    with pytest.raises(FrameError) as error:
        frames.decode_request(frames.encode_request(REQUEST._replace(**change)))
    assert error.value.field == field


@pytest.mark.parametrize("decode", [frames.decode_request, frames.decode_reply])
def test_other_versions_and_sizes_are_refused(decode):
    with pytest.raises(FrameError, match="version: is 1"):
        decode(struct.pack("<H", 1) + bytes(300))
    for size in (0, 1, 2, 39, 41, 279, 281):
        with pytest.raises(FrameError, match="bytes"):
            decode(struct.pack("<H", 2)[:size] + bytes(max(0, size - 2)))


def test_a_reply_cut_short_is_refused(rng):
    extras = Extras(Output.VON_MISES, nodes=5, fields=[rng.random(5, np.float32)])
    frame = frames.encode_reply(REQUEST, step(), extras)
    with pytest.raises(FrameError, match="within von_mises"):
        frames.decode_reply(frame[:-1])
    with pytest.raises(FrameError, match="fields say"):
        frames.decode_reply(frame + b"x")


def test_what_a_displacement_is_made_of_comes_back(rng):
    states, dent = rng.random((2, 5), np.float32), rng.random((3, 3), np.float32)
    models, dented = np.array([7, 4], np.int32), np.array([1, 2, 9], np.int32)
    counts = np.array([2, 5, 3, 0], np.uint32)
    stress = rng.random(11, np.float32).astype(np.float16)
    outputs = Output.PARTS | Output.VON_MISES | Output.HALF
    extras = Extras(outputs, nodes=11, fields=[counts, models, states, dented, dent, stress])
    frame = frames.encode_reply(REQUEST, step(), extras)
    reply = frames.decode_reply(frame)
    for found, sent in (
        (reply.part_models, models), (reply.part_states, states), (reply.dented, dented),
        (reply.dent, dent), (reply.von_mises, stress),
    ):  # fmt: skip
        np.testing.assert_array_equal(found, sent)
    assert reply.displacement is None
    with pytest.raises(FrameError, match="within part_models"):
        frames.decode_reply(frame[: frames.REPLY.itemsize + 18])


def test_the_protocol_has_the_layout():
    """``python -m palpate.online.session.frames`` writes it."""
    told = frames.layout()["reply"]["fields"]
    assert [(f["name"], f["offset"], f["type"], f["shape"]) for f in told] == [
        (name, offset, kind.base.name, kind.shape)
        for name, (kind, offset) in frames.REPLY.fields.items()
    ]
    assert frames.PATH.read_text() == frames.document()


@pytest.mark.parametrize(
    ("flags", "beyond"),
    [
        (Flag.CONVERGED | Flag.IN_RANGE, ()),
        (Flag.CONVERGED | Flag.TOO_DEEP, ("depth",)),
        (Flag.CONVERGED | Flag.BESIDE | Flag.TOO_DEEP, ("position", "depth")),
        (Flag.FALLBACK, ()),
    ],
)
def test_a_reply_has_the_names_of_an_answer_for_how_far_to_trust_it(flags, beyond):
    reply = frames.decode_reply(frames.encode_reply(REQUEST, step(flags)))
    assert reply.converged == (flags != Flag.FALLBACK)
    assert reply.in_range == (flags == Flag.CONVERGED | Flag.IN_RANGE)
    assert reply.out_of_range == beyond
    assert {"converged", "in_range", "out_of_range"} <= set(Answer._fields)
