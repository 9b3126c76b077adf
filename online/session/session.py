"""Sessions: a tool moves, the tissue answers; the newest position counts.

Frames that came while another one was solved are read together, and all but the newest are dropped
and counted. Solves run on the event loop: handing one to a thread and back takes longer. A client
that does not read its replies is cut off after `PATIENCE`; one that sends more than `MOST_FRAMES`
is read no faster than that.
"""

import asyncio
import logging
from collections.abc import Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any, Literal

import orjson
import pydantic
from starlette.types import Message, Receive, Scope, Send

from palpate.online.serve.errors import Refusal, as_refusal, check_json_size
from palpate.online.serve.schemas import Position, Strict, Young, parse
from palpate.online.serve.service import ServedModel, Service
from palpate.online.session import frames
from palpate.online.session.frames import Flag, Output, Request
from palpate.online.session.tracker import LONGEST, ToolTracker, recover
from palpate.online.session.websocket import CONNECTION, LINGER, MOST_FRAMES, STOPPING

logger = logging.getLogger(__name__)

BUDGET = 1e-3
"""Seconds after which no further solve is begun for a step too large to follow at once."""

MOST_AT_ONCE = 100
"""Frames that are passed over for a newer one before one is answered."""

BURST = 0.01
"""Seconds' worth of frames that may come at once."""

PATIENCE = 5.0
"""Seconds a client may leave a reply unread."""

SPARE = 4
"""Sessions of each scene that can be opened at no cost to those under way."""

MOST_SNAPSHOTS = 8
"""Largest number of states that a session keeps."""

GOING_AWAY, IDLE = 1001, 4000
ENDING = {"internal": 1011, "unknown_version": 4001}
"""Codes that a session is closed with; of refusals those that end it."""

Ending = tuple[int, str] | None
"""Code and reason that the service closes a session with; None if the client has gone."""


class Sessions:
    """The ASGI application of every session."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._open = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a session or run it until it ends."""
        served = self.check(scope["path_params"]["name"])
        self._open += 1
        count = self._service.metrics.count
        count("sessions")
        count("sessions_opened_total")
        # a new tracker takes longer than most solves
        tracker = served.spare.pop() if served.spare else ToolTracker(served.model)
        try:
            await Session(self._service, served, tracker, scope, receive, send).run()
        finally:
            self._open -= 1
            count("sessions", by=-1.0)
            tracker.restart()
            served.spare.append(tracker)

    def check(self, name: str) -> ServedModel:
        """Return the model of a scene, or refuse a session of it."""
        served = self._service.model(name)
        if not served.model.has_tip:
            raise Refusal(
                "no_tip", "name", "This scene was trained without a tip; it only answers loads"
            )
        most = self._service.settings.max_sessions
        if self._open >= most:
            raise Refusal(
                "too_many_sessions", "", f"{self._open} sessions are open", {"max_sessions": most}
            )
        return served

    def prepare(self, served: ServedModel, path: Sequence[Sequence[float]]) -> None:
        """Call everything once and make spare trackers; the tip follows `path` (mm)."""
        request = Request(0, 0.0, served.tip, sum(Output))
        served.spare.clear()
        for _ in range(SPARE):
            tracker = ToolTracker(served.model)
            for number, position in enumerate([*path, request.position]):
                answer = tracker.follow(position, BUDGET, 0.01 * number)
            extras = recover(served.model, answer.touch, request.outputs)
            write_reply(frames.encode_reply(request, answer, extras))
            tracker.restart()
            served.spare.append(tracker)


class Session:
    """One client with one tool on a `session.websocket.SessionProtocol`."""

    def __init__(
        self,
        service: Service,
        served: ServedModel,
        tracker: ToolTracker,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        self._service, self._tracker = service, tracker
        self._served, self._model = served, served.model
        self._receive, self._send = receive, send
        self._connection = scope["extensions"][CONNECTION]
        self._received = self._full_at = 0.0
        self._superseded = 0
        self._sending, self._since = True, perf_counter()

    async def run(self) -> None:
        """Greet the client and answer it until either side ends the session."""
        await self._receive()
        await self._send({"type": "websocket.accept"})
        watching = asyncio.create_task(self._watch())
        try:
            async with asyncio.timeout(None) as self._interruption:
                await self._deliver({"type": "websocket.send", "text": self._greeting()})
                ending = await self._converse()
        except TimeoutError:
            ending = await watching
        finally:
            watching.cancel()  # there is nothing to interrupt any more
        if ending is None:
            return
        code, reason = ending
        # a client that does not listen is cut off when this returns
        with suppress(TimeoutError):
            async with asyncio.timeout(LINGER):
                await self._send({"type": "websocket.close", "code": code, "reason": reason})

    async def _watch(self) -> Ending:
        """Interrupt a session whose client is silent, or does not read; tell how it ends."""
        idle = self._service.settings.session_idle
        passed = 0.0
        while passed <= (PATIENCE if self._sending else idle):
            await asyncio.sleep(min(0.25, 0.25 * idle))
            passed = perf_counter() - self._since
        self._interruption.reschedule(asyncio.get_running_loop().time())
        if not self._sending:
            return IDLE, f"no frame for {idle:g} s"
        logger.warning("a session is cut off: its client leaves replies unread")
        return None

    async def _converse(self) -> Ending:
        """Answer the newest message, again and again; tell how the session ends."""
        while True:
            messages, last = await self._take()
            for message in messages:
                reply, ending = self._reply(message)
                await self._deliver(reply)
                if ending is not None:
                    return ending
            if last is not None:
                stopping = last["code"] == STOPPING
                return (GOING_AWAY, "the service is stopping") if stopping else None
            # only now: a message that waits must not grow older because of those behind it
            if (excess := self._full_at - perf_counter() - BURST) > 0.0:
                await asyncio.sleep(excess)

    async def _take(self) -> tuple[list[Message], Message | None]:
        """Wait for messages; return those to answer, in order, and the one that ends the session.

        Of several frames only the newest is answered. A command comes after the frame before it.
        """
        messages: list[Message] = []
        for more in reversed(range(MOST_AT_ONCE)):
            message = await self._receive()
            if message["type"] != "websocket.receive":
                return messages, message
            self._received = self._connection.read_at
            self._full_at = max(self._full_at, perf_counter()) + 1.0 / MOST_FRAMES
            if is_command(message.get("text")):
                return [*messages, message], None
            self._superseded += len(messages)
            messages = [message]
            if not more or self._connection.queue.empty():
                break
        return messages, None

    async def _deliver(self, message: Message) -> None:
        """Send a message; wait until the client has taken most of those before it."""
        self._sending, self._since = True, perf_counter()
        await self._send(message)
        self._sending, self._since = False, perf_counter()

    def _reply(self, message: Message) -> tuple[Message, Ending]:
        """Answer a message as it came, in binary or JSON, or say what is wrong with it."""
        reply: Message = {"type": "websocket.send"}
        ending: Ending = None
        start, frame = perf_counter(), message.get("bytes")
        try:
            if frame is None:
                reply["text"] = self._answer_text(message.get("text") or "", start)
            else:
                reply["bytes"] = self._answer(frames.decode_request(frame), start)
        except Exception as error:
            refusal = as_refusal(error)
            if refusal.code == "internal":
                logger.error("a session failed", exc_info=error)
            self._service.metrics.count("frames_total", "refused")
            reply["text"] = refusal.body().decode()
            if refusal.code in ENDING:
                ending = ENDING[refusal.code], refusal.message
        return reply, ending

    def _answer_text(self, text: str, start: float) -> str:
        """Obey a command or answer a position."""
        if is_command(text):
            return self._obey(parse(TextCommand, text).model_dump(exclude_none=True))
        asked = parse(TextRequest, text)
        nodes, most = len(self._model.surface_nodes), self._service.settings.max_json_numbers
        check_json_size(asked.outputs, nodes, most, "outputs")
        outputs = frames.output_bits(asked.outputs)
        request = Request(asked.seq, asked.client_time, asked.position, outputs)
        return write_reply(self._answer(request, start))

    def _answer(self, request: Request, start: float) -> bytes:
        """Answer a request whose decoding began at `start`."""
        decoded = perf_counter()
        answer = self._tracker.follow(request.position, BUDGET, request.client_time)
        solved = perf_counter()
        extras = recover(self._model, answer.touch, request.outputs)
        recovered = perf_counter()
        received, dropped, self._superseded = self._received, self._superseded, 0
        frame = frames.encode_reply(request, answer, extras, dropped, received, perf_counter())
        borders = (start, decoded, solved, recovered, perf_counter())
        self._service.metrics.count_frame(start - received, borders, answer.flags, dropped)
        return frame

    def _obey(self, given: dict[str, Any]) -> str:
        """Obey a command about the tissue; echo it."""
        if len(given) != 1:
            allowed = [*TextCommand.model_fields]
            raise Refusal("invalid_value", "snapshot", "One command is wanted", allowed)
        ((command, value),) = given.items()
        if command == "restore" and value not in self._tracker.snapshots:
            kept = sorted(self._tracker.snapshots)
            raise Refusal("unknown_snapshot", "restore", "None was kept by this number", kept)
        self._tracker.obey(command, value)
        return orjson.dumps(given).decode()

    def _greeting(self) -> str:
        """Say what is served and how to speak with it."""
        model = self._model
        document = {
            "scene": model.name,
            "artifact": model.seal,
            "tip_radius": model.scene.endoscope.radius,
            "example": {"position": self._served.tip},
            "nodes": len(model.surface_nodes),
            "idle_timeout": self._service.settings.session_idle,
            "max_frames_per_second": MOST_FRAMES,
            "longest_step": LONGEST if model.scene.tissue.prony else None,
            "snapshots": MOST_SNAPSHOTS,
            "server_time": perf_counter(),
            "layout": frames.layout(),
        }
        return orjson.dumps(document).decode()


class TextRequest(Strict):
    """A position of the tip; `seq` and `client_time` are echoed."""

    seq: int = pydantic.Field(0, ge=0, lt=2**32)
    client_time: float = 0.0
    position: Position
    outputs: list[Literal["coordinates", "displacement", "von_mises", "stress"]] = pydantic.Field(
        [], max_length=4
    )


class TextCommand(Strict):
    """A request about the tissue of a session: keep its state, go back to one, or make it as stiff.

    Another Young's modulus (kPa) holds from the next frame on; a past is that of the displacements.
    """

    snapshot: int | None = pydantic.Field(None, ge=0, lt=MOST_SNAPSHOTS)
    restore: int | None = pydantic.Field(None, ge=0, lt=MOST_SNAPSHOTS)
    young: Young = None


def is_command(text: str | None) -> bool:
    """Whether a message is a `TextCommand` rather than a position."""
    return text is not None and any(f'"{name}"' in text for name in TextCommand.model_fields)


def write_reply(frame: bytes) -> str:
    """Write a reply in JSON: bits as lists of names, the reason in words, null for infinity."""
    reply = frames.decode_reply(frame)
    document = {name: value for name, value in reply._asdict().items() if value is not None}
    for name, kind in ("flags", Flag), ("outputs", Output):
        document[name] = [str(bit.name).lower() for bit in kind(document[name])]
    document["reason"] = frames.REASONS_MEAN[reply.reason]
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()
