"""Sessions: a tool moves, the tissue answers; the newest position counts.

Frames that came while another one was solved are read together, and all but the newest are dropped
and counted. Solves run on the event loop: handing one to a thread and back takes longer. A client
that does not read its replies is cut off after `PATIENCE`; one that sends more than `MOST_FRAMES`
is read no faster than that.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum, auto
from time import perf_counter

import orjson
from starlette.types import Message, Receive, Scope, Send

from palpate.online.serve.errors import Refusal, check_json_size, error_body
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import ServedModel, Store
from palpate.online.session import frames
from palpate.online.session.frames import FrameError, Output, Request, VersionError
from palpate.online.session.protocol import layout
from palpate.online.session.realtime import BusyWait
from palpate.online.session.text import (
    MOST_SNAPSHOTS,
    is_command,
    read_command,
    read_request,
    write_reply,
)
from palpate.online.session.tracker import LONGEST, Snapshot, ToolTracker, recover
from palpate.online.session.websocket import LINGER, MOST_FRAMES, PENDING, READ_AT, STOPPING

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

GOING_AWAY, FAILED, IDLE, WRONG_VERSION = 1001, 1011, 4000, 4001
"""Codes that a session is closed with."""


class State(Enum):
    """What a session is doing."""

    CONNECTING = auto()  # the handshake is not answered yet
    WAITING = auto()  # for a message of the client
    SENDING = auto()  # until the client has taken most of what was sent
    CLOSING = auto()  # the service ends it and says why
    CLOSED = auto()


_NEXT = {
    State.CONNECTING: {State.SENDING},
    State.WAITING: {State.SENDING, State.CLOSING, State.CLOSED},
    State.SENDING: {State.WAITING, State.CLOSED},
    State.CLOSING: {State.CLOSED},
    State.CLOSED: set(),
}
"""States that may follow each."""


class Sessions:
    """The ASGI application of every session."""

    def __init__(self, store: Store, settings: Settings, metrics: Metrics) -> None:
        self.settings = settings
        self.metrics = metrics
        self.busy_wait = BusyWait(settings.workers if settings.realtime else 0)
        self._store = store
        self._open = 0
        # a new tracker takes longer than most solves
        self._spare: dict[str, list[ToolTracker]] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a session or run it until it ends."""
        served = self._store.model(scope["path_params"]["name"])
        if not served.model.has_tip:
            raise Refusal(
                "no_tip", "name", "This scene was trained without a tip; it only answers loads"
            )
        most = self.settings.max_sessions
        if self._open >= most:
            raise Refusal(
                "too_many_sessions", "", f"{self._open} sessions are open", {"max_sessions": most}
            )
        self._open += 1
        self.metrics.count_session(opened=True)
        spare = self._spare.setdefault(served.model.name, [])
        tracker = spare.pop() if spare else ToolTracker(served.model)
        try:
            await Session(self, served, tracker, scope, receive, send).run()
        finally:
            self._open -= 1
            self.metrics.count_session(opened=False)
            tracker.restart()
            spare.append(tracker)

    def prepare(self, served: ServedModel, path: Sequence[Sequence[float]]) -> None:
        """Call everything that a session calls once, and make spare trackers.

        The tip follows `path` (mm), which leads through all that the tissue's history may need.
        """
        x, y, z = served.tip
        request = Request(0, 0.0, (x, y, z), sum(Output))
        spare = self._spare[served.model.name] = []
        for _ in range(SPARE):
            tracker = ToolTracker(served.model)
            for number, position in enumerate(path):
                tracker.follow(position, BUDGET, 0.01 * number)
            tracker.restart()
            answer = tracker.follow(request.position, BUDGET)
            extras = recover(served.model, answer.touch, request.outputs)
            write_reply(frames.encode_reply(request, answer, extras))
            tracker.restart()
            spare.append(tracker)


class Session:
    """One client with one tool, whose tracker is new or restarted.

    `scope`, `receive` and `send` are those of `session.websocket.SessionProtocol`.
    """

    def __init__(
        self,
        sessions: Sessions,
        served: ServedModel,
        tracker: ToolTracker,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        self._sessions, self._tracker = sessions, tracker
        self._served, self._model = served, served.model
        self._receive, self._send = receive, send
        self._pending: Callable[[], bool] = scope["extensions"][PENDING]
        self._read_at: Callable[[], float] = scope["extensions"][READ_AT]
        self._snapshots: dict[int, Snapshot] = {}
        self._received = self._full_at = 0.0
        self._superseded = 0
        self._state, self._since = State.CONNECTING, perf_counter()
        self._close_reason = 0, ""

    async def run(self) -> None:
        """Greet the client and answer it until either side ends the session."""
        await self._receive()
        await self._send({"type": "websocket.accept"})
        watching = asyncio.create_task(self._watch())
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(None) as self._interruption:
                    await self._deliver({"type": "websocket.send", "text": self._greeting()})
                    await self._converse()
        finally:
            watching.cancel()  # there is nothing to interrupt any more
        if self._state is State.CLOSING:
            code, reason = self._close_reason
            # a client that does not listen is cut off when this returns
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER):
                    await self._send({"type": "websocket.close", "code": code, "reason": reason})
            self._enter(State.CLOSED)

    def _enter(self, state: State) -> None:
        """Go from one state to another one."""
        if state not in _NEXT[self._state]:
            raise RuntimeError(f"a session cannot go from {self._state} to {state}")
        self._state, self._since = state, perf_counter()

    def _close(self, code: int, reason: str) -> None:
        """Let the session end with a reason."""
        self._enter(State.CLOSING)
        self._close_reason = code, reason

    async def _watch(self) -> None:
        """Interrupt a session whose client is silent, or does not read."""
        idle = self._sessions.settings.session_idle
        while True:
            await asyncio.sleep(min(0.25, 0.25 * idle))
            passed = perf_counter() - self._since
            if self._state is State.SENDING and passed > PATIENCE:
                logger.warning("a session is cut off: its client leaves replies unread")
                self._enter(State.CLOSED)
                break
            if self._state is State.WAITING and passed > idle:
                self._close(IDLE, f"no frame for {idle:g} s")
                break
        self._interruption.reschedule(asyncio.get_running_loop().time())

    async def _converse(self) -> None:
        """Answer the newest message, again and again."""
        while self._state is State.WAITING:
            messages, last = await self._take()
            for message in messages:
                await self._respond(message)
            if last is not None and self._state is State.WAITING:
                if last["code"] == STOPPING:
                    self._close(GOING_AWAY, "the service is stopping")
                else:
                    self._enter(State.CLOSED)
            self._sessions.busy_wait.keep()
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
            self._received = self._read_at()
            self._full_at = max(self._full_at, perf_counter()) + 1.0 / MOST_FRAMES
            if is_command(message.get("text")):
                return [*messages, message], None
            self._superseded += len(messages)
            messages = [message]
            if not (more and self._pending()):
                break
        return messages, None

    async def _respond(self, message: Message) -> None:
        """Answer a message or say what is wrong with it, unless the session is ending."""
        if self._state is not State.WAITING:
            return
        ending = None
        try:
            reply = self._reply(message)
        except Exception as error:
            reply, ending = self._complaint(error)
        await self._deliver(reply)
        if ending is not None:
            self._close(*ending)

    async def _deliver(self, message: Message) -> None:
        """Send a message; wait until the client has taken most of those before it."""
        self._enter(State.SENDING)
        await self._send(message)
        if self._state is State.SENDING:  # it was not cut off meanwhile
            self._enter(State.WAITING)

    def _complaint(self, error: Exception) -> tuple[Message, tuple[int, str] | None]:
        """Say what is wrong with a message, and with what code and reason that ends the session."""
        self._sessions.metrics.count_refused_frame()
        ending = None
        match error:
            case Refusal():
                body = error_body(error.code, error.field, error.message, error.allowed)
            case VersionError():
                body = error_body("unknown_version", error.field, error.message)
                ending = WRONG_VERSION, str(error)
            case FrameError():
                body = error_body("invalid_frame", error.field, error.message)
            case _:
                logger.error("a session failed", exc_info=error)
                body = error_body("internal", "", "The service failed; its log says why")
                ending = FAILED, "the service failed; its log says why"
        return {"type": "websocket.send", "text": body.decode()}, ending

    def _reply(self, message: Message) -> Message:
        """Obey a command, or answer a position as it came: in binary or in JSON."""
        start, frame, text = perf_counter(), message.get("bytes"), message.get("text") or ""
        if frame is not None:
            reply = self._answer(frames.decode_request(frame), start)
            return {"type": "websocket.send", "bytes": reply}
        if is_command(text):
            return {"type": "websocket.send", "text": self._obey(text)}
        request = read_request(text)
        outputs = Output(request.outputs)
        per_node = 3 * (Output.DISPLACEMENT in outputs) + (Output.VON_MISES in outputs)
        numbers = per_node * len(self._model.surface_nodes)
        check_json_size(numbers, self._sessions.settings.max_json_numbers, "outputs")
        return {"type": "websocket.send", "text": write_reply(self._answer(request, start))}

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
        self._sessions.metrics.count_frame(start - received, borders, answer.flags, dropped)
        return frame

    def _obey(self, text: str) -> str:
        """Keep the state of the tissue or go back to one that was kept; echo the command."""
        command, number = read_command(text)
        if command == "snapshot":
            self._snapshots[number] = self._tracker.snapshot()
        elif number in self._snapshots:
            self._tracker.restore(self._snapshots[number])
        else:
            kept = sorted(self._snapshots)
            raise Refusal("unknown_snapshot", "restore", "None was kept by this number", kept)
        return orjson.dumps({command: number}).decode()

    def _greeting(self) -> str:
        """Say what is served and how to speak with it."""
        model = self._model
        document = {
            "scene": model.name,
            "tip_radius": model.scene.endoscope.radius,
            "example": {"position": self._served.tip},
            "nodes": len(model.surface_nodes),
            "idle_timeout": self._sessions.settings.session_idle,
            "max_frames_per_second": MOST_FRAMES,
            "longest_step": LONGEST if model.scene.tissue.prony else None,
            "snapshots": MOST_SNAPSHOTS,
            "server_time": perf_counter(),
            "layout": layout(),
        }
        return orjson.dumps(document).decode()
