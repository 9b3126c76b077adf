"""Inputs that were changed at random, in each of the ways they come in.

Each is refused in a sentence or answered soundly: without a traceback, a crash, a NaN, more than a
second of work, or memory that is not given back.  What a mutation is follows from its number alone.
By default a fiftieth of those are tried that ``PALPATE_MUTATIONS=1`` tries, 2000 artifacts, 4000
requests, 2000 frames, 1000 scenes and 1000 command lines; with ``-s`` their outcomes are counted.
"""

import json
import os
import re
import socket
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline import train
from palpate.offline.scenes import FOLDER as SCENES
from palpate.offline.scenes import filled, shipped_scenes
from palpate.online.client.session import Session, SessionClosed
from palpate.online.serve import layout
from palpate.online.session import frames
from palpate.online.session.frames import Request
from palpate.shared.artifact import ArtifactError, read_artifact
from palpate.shared.cli import main
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import STORED, ReducedModel
from palpate.shared.scene import SceneError, load_scene, parse_scene

from ..conftest import sealed
from . import mutations
from .conftest import process_memory
from .mutations import changed_bytes, changed_document, changed_lines, changed_words, pick

pytestmark = pytest.mark.service

SHARE = float(os.environ.get("PALPATE_MUTATIONS", "0.02"))
SLOWEST = 1.0  # s of a processor's time
MEMORY = 200e6  # bytes that may be taken for good by all mutations of a kind


def process_time(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Tally:
    """The mutations of a kind, what became of them, and what they took of a process."""

    def __init__(self, kind, most, pid=None, slowest=SLOWEST):
        self.kind, self.count, self.pid = kind, max(1, round(SHARE * most)), pid or os.getpid()
        self.limit, self.slowest, self.outcomes = slowest, 0.0, Counter()

    def __iter__(self):
        """Go through the mutations; each has a generator of its own."""
        before = None
        for number in range(self.count):
            start = process_time(self.pid)
            try:
                yield np.random.default_rng([*self.kind.encode(), number])
            except GeneratorExit:
                print(f"{self.kind}: stopped at mutation {number}")
                raise
            took = process_time(self.pid) - start
            self.slowest = max(self.slowest, took)
            assert took < self.limit, f"{self.kind} {number} took {took:.1f} s"
            before = before or process_memory(self.pid)  # the first may load and compile
        grown = process_memory(self.pid) - before
        told = ", ".join(f"{number} {what}" for what, number in sorted(self.outcomes.items()))
        print(f"{self.kind}: {told}; slowest {self.slowest:.2f} s, {grown / 1e6:.0f} MB more")
        assert grown < MEMORY

    def note(self, outcome):
        self.outcomes[outcome] += 1


def finite(numbers):
    assert np.isfinite(np.asarray(numbers, float)).all()


def no_constant(name):
    raise AssertionError(f"{name} is not JSON")


def sentence(text, path=""):
    """What is said to people is short, no traceback, and names the file."""
    assert text.startswith(f"{path}:" if path else "")
    assert text.strip()
    assert "Traceback" not in text
    assert len(text) < 5000


@pytest.fixture(scope="module")
def whole(artifact):
    return read_artifact(artifact, *STORED)


def test_artifacts_that_are_sealed_anew(whole, atlas, tmp_path, rng):
    # of this, loading takes 0.4 s, and kernels for another kind of model as much again
    path, tally = tmp_path / "resealed.h5", Tally("artifacts", 2000, slowest=3.0)
    assert answers(atlas, rng)  # once all is compiled
    for rng in tally:
        arrays, scene, documents = dict(whole.arrays), whole.scene, whole.documents
        for _ in range(rng.integers(1, 3)):
            kind = rng.random()
            if kind < 0.1:
                scene = changed_lines(rng, scene)
            elif kind < 0.2:
                documents = changed_document(rng, documents)
            else:
                name = pick(rng, list(arrays))
                arrays[name] = mutations.changed_array(rng, arrays[name])
                if arrays[name] is None:
                    del arrays[name]
        scene = scene.replace("\x00", "")
        sealed(path, whole, scene=scene, documents=documents, arrays=arrays)
        try:
            model = ReducedModel.load(path)
        except ArtifactError as error:
            sentence(str(error), path)
            tally.note("refused")
            continue
        tally.note("answered" if answers(model, rng) else "answered that there is none")


def answers(model, rng):
    """Whether a model has answers to some loads and positions; those are numbers."""
    found = 0
    for x in rng.choice(model.surface.vertices, 4):
        try:
            asked = [model.press(x, 0.5)]
            asked += [model.touch(x + np.array([0.0, 0.0, 1.5]))] if model.has_tip else []
        except QueryError as error:
            sentence(str(error))
            continue
        for answer in asked:
            if answer.converged:
                found += 1
                finite([*answer.force, *answer.contact_displacement, answer.energy])
                assert not np.isnan(answer.error_displacement)
    return found


LOAD = {"position": [5.0, 5.0, 8.0], "pressure": 1.0}
BODIES = {
    "solve": {"contacts": [LOAD | {"direction": [0.1, 0.0, -1.0], "radius": 2.0}]},
    "solve?": {"contacts": [LOAD], "outputs": ["displacement", "peak"], "region": "surface"},
    "check": {"contacts": [LOAD]},
    "history": {"steps": [{"time": 0.1, "contact": LOAD}, {"time": 1.0}]},
    "solve-many": {"positions": 3 * [[5.0, 5.0, 8.0]], "pressures": [1.0, 2.0, 0.0]},
    "touch": {"positions": [[5.0, 5.0, 9.8], [4.0, 5.0, 9.9]]},
}
PLACES = [
    "/health", "/ready", "/metrics", "/scenes", "/scenes/quick", "/scenes/quick/mesh?region=all",
    "/scenes/quick/accessible", "/scenes/quick/session", "/openapi.json", "/docs", "/",
]  # fmt: skip
KINDS = [layout.JSON, layout.BINARY, "application/msgpack", "*/*", "text/html;q=0.5, */*;q=0.1"]


def request_of(rng):
    """A request, changed as a document, as bytes, or both; and its load if only the document is."""
    head = f"accept: {pick(rng, KINDS)}\r\nhost: localhost\r\nconnection: close\r\n"
    if rng.random() < 0.25:
        first = f"{pick(rng, ['GET', 'GET', 'POST', 'HEAD', 'PUT'])} {pick(rng, PLACES)} HTTP/1.1"
        return changed_bytes(rng, f"{first}\r\n{head}\r\n".encode()), None
    verb = pick(rng, list(BODIES))
    document, kind = BODIES[verb], layout.JSON
    if rng.random() < 0.7:
        document = changed_document(rng, document)
    body = json.dumps(document).encode()
    if verb in ("solve-many", "touch") and rng.random() < 0.5:
        kind = layout.BINARY
        arrays = {name: np.array(rows, float) for name, rows in BODIES[verb].items()}
        name = pick(rng, list(arrays))
        changed = mutations.changed_array(rng, arrays.pop(name))
        if changed is not None and changed.dtype.name in layout.DTYPES:
            arrays[name] = np.ascontiguousarray(changed)
        body = layout.encode({}, arrays)
    whole = rng.random() < 0.6
    if not whole and rng.random() < 0.5:
        body = changed_bytes(rng, body)
    head += f"content-type: {kind}\r\ncontent-length: {len(body)}\r\n\r\n"
    asked = f"POST /scenes/quick/{verb.rstrip('?')} HTTP/1.1\r\n{head}".encode()
    if not whole:
        asked = changed_bytes(rng, asked, 2)
    load = document if whole and verb.startswith("solve") and verb != "solve-many" else None
    return asked + body, load


def response_to(url, request):
    """Status, media type and body that a service sends; a status of 0 if it waits for more."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port)) as connection:
        connection.settimeout(0.5)
        said = b""
        try:
            connection.sendall(request)
            while piece := connection.recv(1 << 20):
                said += piece
        except TimeoutError:
            if not said:
                return 0, "", b""
        except ConnectionError:
            pass
    head, _, body = said.partition(b"\r\n\r\n")
    found = re.match(rb"HTTP/1\.1 (\d{3}) ", head)
    assert found or not said, said[:100]
    kind = re.search(rb"(?im)^content-type: ([^;\r]*)", head)
    return int(found[1]) if found else -1, kind[1].decode() if kind else "", body


def check_body(status, kind, body):
    """Check that a body has no NaN, and says what is wrong if something is."""
    if kind == layout.JSON and body:
        document = json.loads(body, parse_constant=no_constant)
        if status >= 400:
            sentence(document["error"]["message"])
    elif kind in (layout.BINARY, "application/msgpack"):
        if kind == layout.BINARY:
            _, arrays = layout.decode(body)
        else:
            fields = msgpack.unpackb(body)["fields"]
            arrays = {name: np.frombuffer(f["data"], f["dtype"]) for name, f in fields.items()}
        for name, values in arrays.items():
            assert not np.isnan(values).any(), name
            if not name.startswith("error_"):
                finite(values)


def test_requests(serve, artifact, atlas):
    with serve(artifact.parent) as server:
        tally = Tally("requests", 4000, server.process.pid)
        for rng in tally:
            request, load = request_of(rng)
            status, kind, body = response_to(server.url, request)
            assert status in (-1, 0, 200, 101) or 400 <= status < 500 or status == 505, request
            if status in (-1, 0):
                tally.note("waited for" if status == 0 else "closed")
                continue
            check_body(status, kind, body)
            tally.note(str(status))
            if status == 200 and load is not None and kind == layout.JSON:
                (contact,) = load["contacts"]
                expected = atlas.press(**contact)
                np.testing.assert_allclose(json.loads(body)["force"], expected.force, rtol=1e-9)
        assert server.stop() == 0
    assert "Traceback" not in server.log


def message_of(rng, surface):
    """A message of a session and, if it is a good frame still, its position."""
    at = pick(rng, surface.vertices) + rng.uniform(-0.5, 2.5, 3)
    frame = frames.encode_request(Request(int(rng.integers(2**32)), rng.normal(), at.tolist()))
    match rng.integers(5):
        case 0:
            return frame, at
        case 1:
            return changed_bytes(rng, frame), None
        case 2:
            odd = np.frombuffer(frame, frames.REQUEST).copy()
            name = pick(rng, odd.dtype.names)
            odd[name] = np.asarray(pick(rng, [0, 1, 7, 65535, 1e9])).astype(odd[name].dtype)
            return odd.tobytes(), None
    document = pick(rng, [{"position": at.tolist(), "outputs": ["stress"]}, {"snapshot": 1}])
    text = json.dumps(changed_document(rng, document))
    return (changed_bytes(rng, text.encode()) if rng.random() < 0.3 else text.encode()), "text"


def test_frames(serve, artifact, atlas):
    with serve(artifact.parent) as server, ExitStack() as stack:
        session = stack.enter_context(Session(server.url, "quick"))
        tally = Tally("frames", 2000, server.process.pid)
        for rng in tally:
            message, at = message_of(rng, atlas.surface)
            protocol = session._connection.protocol
            (protocol.send_text if isinstance(at, str) else protocol.send_binary)(message)
            session._connection.flush()
            try:
                answer = session._connection.receive()
                tally.note(outcome_of(answer, at, atlas))
                if "unknown_version" not in str(answer):
                    continue
                session._connection.receive()
            except SessionClosed as closed:
                tally.note(f"ended with {closed.code}")
            session.close()
            session = stack.enter_context(Session(server.url, "quick"))
        session.close()
        assert server.stop() == 0
    codes = {outcome for outcome in tally.outcomes if outcome.startswith("ended")}
    assert codes <= {f"ended with {code}" for code in (1002, 1007, 1009, 4001)}
    assert "Traceback" not in server.log


def outcome_of(answer, at, atlas):
    """Check an answer, beside what the model says from rest if a good frame asked for it."""
    if isinstance(answer, str):
        document = json.loads(answer, parse_constant=no_constant)
        if "error" in document:
            sentence(document["error"]["message"])
            return "refused"
        return "answered as text"
    reply = frames.decode_reply(answer)
    for name, value in reply._asdict().items():
        if value is not None and not (name.startswith("error_") and not reply.good):
            finite(value)
    if reply.good and isinstance(at, np.ndarray):
        force = atlas.touch(at).force
        assert np.linalg.norm(reply.force - force) <= 1e-3 * np.linalg.norm(force) + 1e-6
    return "answered" if reply.good else "answered that it is not good"


def test_scenes(tmp_path):
    texts = [(SCENES / f"{name}.toml").read_text() for name in shipped_scenes()]
    path, tally = tmp_path / "own.toml", Tally("scenes", 1000)
    for rng in tally:
        text = changed_lines(rng, pick(rng, texts))
        content = text.encode()
        path.write_bytes(changed_bytes(rng, content, 1) if rng.random() < 0.2 else content)
        try:
            scene = load_scene(path)
        except SceneError as error:
            sentence(str(error), path)
            tally.note("refused")
            continue
        again = parse_scene(filled(scene))
        assert again.model_dump() == scene.model_dump()
        tally.note("read")


COMMANDS = [
    "solve A.h5 --at 4 5.5 8 --pressure 1.5 --json",
    "solve A.h5 --at 4 5.5 8 --pressure 1.5 --direction 0.1 0 -1 --radius 2",
    "solve A.h5 --at 5 5 9.8 --tip",
    "solve A.h5 --csv loads.csv --out found.csv",
    "solve A.h5 --at 4 5.5 8 --pressure 1.5 --vtu found.vtu",
    "info A.h5 --json", "info A.h5 --errors", "info text.h5",
    "scene quick", "scene own.toml", "scene --keys",
    "new new.toml --shape block", "new new.toml --shape section",
    "train own.toml --check", "train quick --check --workers 2", "train own.toml --out out.h5",
    "replay session.h5 A.h5 --json", "replay text.h5 A.h5",
    "loadtest http://127.0.0.1:1 quick --sessions 2 --duration 1",
    "serve --artifacts nowhere --port 8000 --rate-limit 10",
    "validate text.h5 --queries 3", "bench text.h5", "picture text.h5 --at 1 2 3 --out x.png",
]  # fmt: skip


def untrained(*_):
    raise PalpateError("this takes too long here")


def prepared(artifact):
    """Fill the working directory with what the commands name."""
    for name in os.listdir():
        os.unlink(name)
    os.symlink(artifact, "A.h5")
    Path("text.h5").write_text("no artifact")
    Path("own.toml").write_text((SCENES / "quick.toml").read_text())
    Path("loads.csv").write_text("x,y,z,pressure\n5,5,8,1\n")


def test_command_lines(artifact, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "train", untrained)
    tally, runner = Tally("command lines", 1000), CliRunner()
    prepared(artifact)
    done = [not runner.invoke(main, command.split()).exit_code for command in COMMANDS]
    assert sum(done) == 13  # the others name what is not there
    for rng in tally:
        prepared(artifact)
        words = changed_words(rng, pick(rng, COMMANDS).split())
        result = runner.invoke(main, words)
        assert result.exception is None or isinstance(result.exception, SystemExit), words
        assert result.exit_code in (0, 1, 2), words
        sentence(result.output[-4000:])
        tally.note("refused" if result.exit_code else "done")
        if words[0] == "solve" and "--json" in words and not result.exit_code:
            report = json.loads(result.stdout, parse_constant=no_constant)
            finite(report.get("force", 0.0))
