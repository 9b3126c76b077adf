import asyncio
import select

import numpy as np
import pytest
from websockets.protocol import State

from palpate.online.client.http import AsyncClient, Client, ServiceError
from palpate.online.client.session import AsyncSession, SessionClosed
from palpate.online.session.recording import read_recording
from palpate.shared.errors import PalpateError

from ..fake_model import FakeModel


def test_it_asks_and_understands(url):
    atlas = FakeModel()
    with Client(url) as client:
        assert [scene["name"] for scene in client.scenes()["scenes"]] == ["toy"]
        assert client.scene("toy")["ranges"]["reach"] == 3.0
        mesh = client.mesh("toy", region="all")
        answer = client.solve("toy", (5, 5, 5), 4.0, direction=(0, 0, -1), radius=1.5, region="all")
    solution = atlas.solve((5, 5, 5), 4.0, (0, 0, -1), 1.5)
    np.testing.assert_allclose(mesh.nodes, atlas.nodes, atol=1e-6)
    np.testing.assert_allclose(answer.force, solution.force)
    np.testing.assert_array_equal(answer.displacement, atlas.displacement(solution, "all"))
    np.testing.assert_array_equal(answer.von_mises, atlas.von_mises(solution, "all"))
    assert answer.trust["out_of_range"] == ["radius"]


def test_fields_not_asked_for_are_none(url):
    with Client(url) as client:
        answer = client.solve("toy", (5, 5, 5), 4.0)
    assert answer.displacement is None
    assert answer.von_mises is None


def test_refusals_are_raised(url):
    with Client(url) as client:
        with pytest.raises(ServiceError, match="greater than or equal") as refused:
            client.solve("toy", (5, 5, 5), -4.0)
        assert (refused.value.status, refused.value.field) == (422, "contacts.0.pressure")
        with pytest.raises(ServiceError) as refused:
            client.scene("a/b c")
        assert refused.value.status == 404


@pytest.mark.parametrize("url", ["toy", "https://127.0.0.1:1", "http://"])
def test_other_addresses_are_refused(url):
    with pytest.raises(PalpateError, match="not an address"):
        Client(url)


def test_the_asyncio_client_answers_alike(url):
    async def run():
        async with AsyncClient(url) as client:
            mesh = await client.mesh("toy")
            solved = await client.solve("toy", (5, 5, 5), 4.0, region="surface")
            async with client.session("toy") as session:
                reply = await session.step((5.0, 5.0, 6.5))
                hello = session.hello
            return await client.scenes(), await client.scene("toy"), mesh, solved, reply, hello

    scenes, scene, mesh, solved, reply, hello = asyncio.run(run())
    with Client(url) as client, client.session("toy") as session:
        assert client.scenes() == scenes
        assert client.scene("toy") == scene
        np.testing.assert_array_equal(client.mesh("toy").nodes, mesh.nodes)
        expected = client.solve("toy", (5, 5, 5), 4.0, region="surface")
        np.testing.assert_array_equal(solved.displacement, expected.displacement)
        np.testing.assert_array_equal(session.step((5.0, 5.0, 6.5)).force, reply.force)
        assert session.hello["layout"] == hello["layout"]


def test_the_asyncio_client_raises_alike(url):
    async def run():
        async with AsyncClient(url) as client:
            with pytest.raises(ServiceError, match="greater than or equal"):
                await client.solve("toy", (5, 5, 5), -4.0)
            with pytest.raises(ServiceError, match="No such scene") as refused:
                async with client.session("other"):
                    pass
            async with client.session("toy") as session:
                await session.send((float("nan"), 0.0, 0.0))
                with pytest.raises(ServiceError, match="three numbers"):
                    await session.receive()
                await session._connection.send(bytes(10**5))
                with pytest.raises(SessionClosed) as closed:
                    await session.receive()
            return refused.value.status, closed.value.code

    assert asyncio.run(run()) == (404, 1009)


def test_poll_does_not_wait(url):
    with Client(url) as client, client.session("toy") as session:
        assert session.poll() is None
        seq = session.send((5.0, 5.0, 6.5))
        select.select([session], [], [])
        while (reply := session.poll()) is None:
            pass
        assert reply.seq == seq
        assert session.poll() is None


def test_a_session_that_cannot_be_recorded_is_closed(url, tmp_path):
    """There is no such folder: the error is told, and the session's place is free again."""
    session = AsyncSession(url, "toy", record=tmp_path / "missing" / "session.h5")

    async def run():
        with pytest.raises(FileNotFoundError):
            async with session:
                pass
        return session._connection.state

    assert asyncio.run(run()) is State.CLOSED


def test_a_recording_is_whole_even_if_closing_fails(url, tmp_path, monkeypatch):
    path = tmp_path / "session.h5"

    async def run():
        async with AsyncSession(url, "toy", record=path) as session:
            await session.step((5.0, 5.0, 6.5))
            connection, closing = session._connection, session._connection.close()

            async def close():
                await closing
                raise OSError("gone")

            monkeypatch.setattr(connection, "close", close)

    with pytest.raises(OSError, match="gone"):
        asyncio.run(run())
    assert len(read_recording(path).requests) == 1
