"""Sessions: a tool moves, the tissue answers; the newest position counts.

Frames that came while another one was solved are read together, and all but the newest are dropped
and counted. Solves run on the event loop, since handing one to a thread and back takes longer than
the solve. A client that does not read its replies holds up itself alone, and is cut off after
`PATIENCE`; one that sends more than `MOST_FRAMES` is read no faster than that.
"""

import asyncio
import logging
import math
from collections.abc import Callable
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np
import orjson
from starlette.types import Message, Receive, Scope, Send

from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.schemas import (
    MOST_SNAPSHOTS,
    is_command,
    parse_session_command,
    parse_session_request,
)
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import Model, Store
from palpate.online.session import frames
from palpate.online.session.follower import Follower, Step
from palpate.online.session.frames import Extras, Flag, FrameError, Output, Request, VersionError
from palpate.online.session.realtime import BusyWait
from palpate.online.session.timed_follower import LONGEST, follower_of
from palpate.online.session.websocket import LINGER, MOST_FRAMES, PENDING, READ_AT, STOPPING
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.touch import Touch

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
"""Sessions that can be opened at no cost to those under way."""

GOING_AWAY, FAILED, IDLE, WRONG_VERSION = 1001, 1011, 4000, 4001
"""Codes that a session is closed with."""

_COORDINATES, _DISPLACEMENT, _VON_MISES, _STRESS, _HALF = map(int, Output)


class Sessions:
    """The ASGI application of every session.

    Parameters
    ----------
    store : Store
    settings : Settings
    metrics : Metrics
    """

    def __init__(self, store: Store, settings: Settings, metrics: Metrics) -> None:
        self._store = store
        self._settings = settings
        self._metrics = metrics
        self._vigil = BusyWait(settings.workers if settings.realtime else 0)
        self._open = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a session or run it until it ends."""
        model = self._store.model(scope["path_params"]["name"])
        if model.atlas.tips is None:
            raise Refusal(
                "no_tip", "name", "This scene was trained without a tip; it only answers loads"
            )
        most = self._settings.max_sessions
        if self._open >= most:
            raise Refusal(
                "too_many_sessions", "", f"{self._open} sessions are open", {"max_sessions": most}
            )
        self._open += 1
        self._metrics.count_session(opened=True)
        follower = model.followers.pop() if model.followers else follower_of(model.atlas)
        try:
            session = Session(
                model, follower, self._settings, self._metrics, self._vigil, scope, receive, send
            )
            await session.run()
        finally:
            self._open -= 1
            self._metrics.count_session(opened=False)
            follower.restart()
            model.followers.append(follower)


class Session:
    """One client with one tool.

    Parameters
    ----------
    model : Model
    follower : Follower
        Fresh or restarted.
    settings : Settings
    metrics : Metrics
    vigil : BusyWait
        Of the event loop.
    scope, receive, send
        As ASGI gives them; of `session.websocket.Protocol`.
    """

    def __init__(
        self,
        model: Model,
        follower: Follower,
        settings: Settings,
        metrics: Metrics,
        vigil: BusyWait,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        self._model = model
        self._atlas = model.atlas
        self._settings = settings
        self._metrics = metrics
        self._vigil = vigil
        self._receive = receive
        self._send = send
        self._pending: Callable[[], bool] = scope["extensions"][PENDING]
        self._read_at: Callable[[], float] = scope["extensions"][READ_AT]
        self._follower = follower
        self._snapshots: dict[int, Any] = {}
        self._received = perf_counter()
        self._superseded = 0
        self._sending_since = math.inf
        self._full_at = 0.0
        self._farewell: tuple[int, str] | None = None

    async def run(self) -> None:
        """Welcome the client and answer it until it goes or is told to."""
        await self._receive()
        await self._send({"type": "websocket.accept"})
        watching = asyncio.create_task(self._watch())
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(None) as self._interruption:
                    await self._deliver({"type": "websocket.send", "text": self._hello()})
                    await self._converse()
        finally:
            watching.cancel()  # there is nothing to interrupt any more
        if self._farewell is not None:
            code, reason = self._farewell
            # a client that does not listen is cut off when this returns
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER):
                    await self._send({"type": "websocket.close", "code": code, "reason": reason})

    async def _converse(self) -> None:
        """Answer the newest message, again and again."""
        while self._farewell is None:
            message = newest = await self._receive()
            for more in reversed(range(MOST_AT_ONCE)):
                if message["type"] != "websocket.receive":
                    break
                self._note()
                newest = message
                if is_command(message.get("text") or "") or not (more and self._pending()):
                    break
                message = await self._receive()
                if is_command(message.get("text") or ""):  # it is of the state after the newest
                    await self._deliver(self._reply(newest))
                else:
                    self._superseded += message["type"] == "websocket.receive"
            if newest["type"] == "websocket.receive":
                await self._deliver(self._reply(newest))
            if message["type"] != "websocket.receive":
                if message["code"] == STOPPING:
                    self._farewell = GOING_AWAY, "the service is stopping"
                return
            self._vigil.keep()
            # only now: a message that waits must not grow older for those behind it
            if (excess := self._full_at - perf_counter() - BURST) > 0.0:
                await asyncio.sleep(excess)

    def _note(self) -> None:
        """Note that a message has come."""
        self._received = self._read_at()
        self._full_at = max(self._full_at, perf_counter()) + 1.0 / MOST_FRAMES

    async def _deliver(self, message: Message) -> None:
        """Send a message; wait until the client has taken most of those before it."""
        self._sending_since = perf_counter()
        await self._send(message)
        self._sending_since = math.inf

    async def _watch(self) -> None:
        """Interrupt a session whose client is silent, or does not listen."""
        idle = self._settings.session_idle
        while True:
            await asyncio.sleep(min(0.25, 0.25 * idle))
            now = perf_counter()
            if now - self._sending_since > PATIENCE:
                logger.warning("a session is cut off: its client leaves replies unread")
                break
            if now - self._received > idle:
                self._farewell = IDLE, f"no frame for {idle:g} s"
                break
        self._interruption.reschedule(asyncio.get_running_loop().time())

    def _reply(self, message: Message) -> Message:
        """Answer a message or say what is wrong with it."""
        try:
            frame = message.get("bytes")
            if frame is not None:
                return {"type": "websocket.send", "bytes": self._answer_frame(frame)}
            return {"type": "websocket.send", "text": self._answer_text(message["text"])}
        except VersionError as error:
            self._farewell = WRONG_VERSION, str(error)
            return self._complain("unknown_version", error.field, error.message)
        except FrameError as error:
            return self._complain("invalid_frame", error.field, error.message)
        except Refusal as refusal:
            return self._complain(refusal.code, refusal.field, refusal.message, refusal.allowed)
        except Exception:
            logger.exception("a session failed")
            self._farewell = FAILED, "the service failed; its log says why"
            return self._complain("internal", "", "The service failed; its log says why")

    def _answer_frame(self, frame: bytes) -> bytes:
        start = perf_counter()
        return self._solve(frames.decode_request(frame), start)[0]

    def _answer_text(self, text: str) -> str:
        """Answer in JSON: the same fields by name, bits as lists of names, and a reason."""
        if is_command(text):
            return self._obey(text)
        start = perf_counter()
        request = parse_session_request(text)
        self._check_size(request.outputs)
        frame, step = self._solve(request, start)
        reply = frames.decode_reply(frame)
        document = {name: value for name, value in reply._asdict().items() if value is not None}
        document["flags"] = _names(Flag(reply.flags))
        document["outputs"] = _names(Output(reply.outputs))
        document["reason"] = step.reason
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()

    def _obey(self, text: str) -> str:
        """Keep the state of the tissue or go back to one that was kept; echo the command."""
        restores, number = parse_session_command(text)
        if not restores:
            self._snapshots[number] = self._follower.snapshot()
        elif number in self._snapshots:
            self._follower.restore(self._snapshots[number])
        else:
            raise Refusal(
                "unknown_snapshot", "restore", "None was kept by this number",
                sorted(self._snapshots),
            )  # fmt: skip
        return orjson.dumps({"restore" if restores else "snapshot": number}).decode()

    def _solve(self, request: Request, start: float) -> tuple[bytes, Step]:
        """Answer a request whose decoding began at `start`: the reply's frame and its content."""
        decoded = perf_counter()
        step = self._follower.follow(request.position, BUDGET, request.client_time)
        solved = perf_counter()
        extras = recover(self._atlas, step.touch, request.outputs)
        recovered = perf_counter()
        superseded, self._superseded = self._superseded, 0
        frame = frames.encode_reply(
            request, step, extras, superseded, self._received, perf_counter()
        )
        borders = (start, decoded, solved, recovered, perf_counter())
        self._metrics.count_frame(start - self._received, borders, step.flags, superseded)
        return frame, step

    def _complain(self, code: str, field: str, message: str, allowed: Any = None) -> Message:
        self._metrics.count_refused_frame()
        error = {"code": code, "field": field, "message": message, "allowed": allowed}
        return {"type": "websocket.send", "text": orjson.dumps({"error": error}).decode()}

    def _check_size(self, outputs: int) -> None:
        """Refuse fields that would keep the event loop busy writing decimals."""
        per_node = 3 * bool(outputs & _DISPLACEMENT) + bool(outputs & _VON_MISES)
        numbers = per_node * len(self._atlas.surface_nodes)
        if numbers > self._settings.max_json_numbers:
            raise Refusal(
                "too_large_for_json",
                "outputs",
                f"{numbers} numbers are too many for JSON; send binary frames instead",
                {"max_numbers": self._settings.max_json_numbers},
            )

    def _hello(self) -> str:
        """Say what is served and how to speak with it."""
        atlas = self._atlas
        document = {
            "scene": atlas.name,
            "tip_radius": atlas.scene.endoscope.radius,
            "example": {"position": self._model.tip},
            "nodes": len(atlas.surface_nodes),
            "idle_timeout": self._settings.session_idle,
            "max_frames_per_second": MOST_FRAMES,
            "longest_step": LONGEST if atlas.scene.tissue.prony else None,
            "snapshots": MOST_SNAPSHOTS,
            "server_time": perf_counter(),
            "layout": frames.layout(),
        }
        return orjson.dumps(document).decode()


def warm(model: Model, metrics: Metrics) -> None:
    """Call all that a session calls once, and keep what the first sessions need at hand."""
    if model.atlas.tips is None:
        return
    x, y, z = model.tip
    request = Request(0, 0.0, (x, y, z), sum(Output))
    for _ in range(SPARE):
        follower = follower_of(model.atlas)
        _wander(follower, model.atlas)
        step = follower.follow(request.position, BUDGET)
        frames.encode_reply(request, step, recover(model.atlas, step.touch, request.outputs))
        metrics.count_frame(0.0, (0.0, 0.0, 0.0, 0.0, 0.0), step.flags, 0)
        follower.restart()
        model.followers.append(follower)


def _wander(follower: Follower, atlas: ReducedModel) -> None:
    """Go from one local model to the next and back: all that a history may need."""
    models = atlas.models
    if models.viscous is None:
        return
    over = models.centres + 0.9 * atlas.scene.endoscope.radius * models.frames[:, 0]
    here, there = models.viscous.pairs[0]
    for number, k in enumerate((here, there, here)):
        follower.follow(over[k].tolist(), BUDGET, 0.01 * number)
    follower.restart()


def recover(atlas: ReducedModel, touch: Touch, outputs: int) -> Extras:
    """Get what a request asked for beyond force and tangent."""
    if not outputs & ~_HALF:
        return frames.NO_EXTRAS
    kind = np.float16 if outputs & _HALF else np.float32
    coordinates = displacement = von_mises = None
    largest = percentile = 0.0
    if outputs & _COORDINATES:
        coordinates = _coordinates(touch)
    if outputs & (_DISPLACEMENT | _VON_MISES | _STRESS):
        everywhere = atlas.displacement(touch)
        if outputs & _DISPLACEMENT:
            displacement = everywhere[atlas.surface_nodes].astype(kind)
        if outputs & (_VON_MISES | _STRESS):
            stress = atlas.von_mises(touch, "all", everywhere)
            if outputs & _VON_MISES:
                von_mises = stress[atlas.surface_nodes].astype(kind)
            if outputs & _STRESS:
                largest, percentile = np.percentile(stress, (100.0, 99.0)).tolist()
    return Extras(outputs, coordinates, displacement, von_mises, largest, percentile)


def _coordinates(touch: Touch) -> np.ndarray:
    """Reduced coordinates (MODELS, r), a row per local model."""
    r = max((len(c) for _, _, c in touch.patches), default=0)
    rows = np.zeros((frames.MODELS, r), np.float32)
    for row, (_, _, c) in zip(rows, touch.patches, strict=False):
        row[:] = c
    return rows


def _names(bits: Any) -> list[str]:
    return [bit.name.lower() for bit in bits]
