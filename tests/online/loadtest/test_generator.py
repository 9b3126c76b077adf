import socket

import numpy as np
import pytest

from palpate.online.loadtest.generator import Log, drive


class Echo:
    """A stream whose other end answers at once, `chunk` messages at a time."""

    def __init__(self, due):
        self.log = Log(np.asarray(due))
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.sockets = (self.near,)
        self.order = []

    @property
    def waiting(self):
        return any(s and not r for s, r in zip(self.log.sent, self.log.received, strict=True))

    def send(self, number, now):
        self.order.append(number)
        self.log.sent[number] = now
        self.far.sendall(bytes([number]))

    def receive(self, connection, now):
        for number in connection.recv(100):
            self.log.received[number] = now
        return True

    def close(self):
        self.near.close()
        self.far.close()


@pytest.fixture
def echoes():
    streams = [Echo([0.01, 0.03, 0.3]), Echo([0.0, 0.02, 0.31])]
    yield streams
    for stream in streams:
        stream.close()


def test_every_message_is_sent_when_due_and_its_answer_taken(echoes):
    machine = drive(echoes)
    for stream in echoes:
        assert stream.order == [0, 1, 2]
        for due, sent, received in zip(
            stream.log.due, stream.log.sent, stream.log.received, strict=True
        ):
            assert due <= sent < received
    assert (np.diff(machine.borders) > 0).all()
    assert machine.borders[-1] >= max(stream.log.received[-1] for stream in echoes)
    assert len(machine.steal) == len(machine.borders) - 1 >= 2


def test_a_hang_up_ends_the_stream_only(echoes):
    class HangsUp(Echo):
        def receive(self, connection, now):
            super().receive(connection, now)
            return False

    short = HangsUp([0.0, 0.1])
    drive([short, *echoes])
    assert short.log.received[0] > 0
    assert short.log.received[1] == 0
    assert all(stream.log.received[-1] for stream in echoes)
    short.close()
