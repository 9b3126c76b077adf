"""The online commands of ``palpate``.

Each imports what it runs when it runs, so that ``--help`` is instant.
"""

import json
import logging
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from shared.errors import PalpateError

if TYPE_CHECKING:
    from online.store import Store


@click.command()
@click.option(
    "--artifacts",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("artifacts"),
    envvar="PALPATE_ARTIFACTS",
    show_default=True,
    show_envvar=True,
    help="Directory whose *.h5 are served.",
)
@click.option(
    "--host", default="127.0.0.1", envvar="PALPATE_HOST", show_default=True, show_envvar=True
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8000,
    envvar="PALPATE_PORT",
    show_default=True,
    show_envvar=True,
    help="0 takes a free one.",
)
@click.option(
    "--max-sessions",
    type=click.IntRange(0),
    default=16,
    envvar="PALPATE_MAX_SESSIONS",
    show_default=True,
    show_envvar=True,
    help="Most sessions at a time; more are refused.",
)
@click.option(
    "--session-idle",
    type=click.FloatRange(0.1),
    default=60.0,
    envvar="PALPATE_SESSION_IDLE",
    show_default=True,
    show_envvar=True,
    help="Seconds after which a silent session is closed.",
)
@click.option("--echo", is_flag=True, help="Answer WS /echo, for palpate latency --session.")
def serve(
    artifacts: Path, host: str, port: int, max_sessions: int, session_idle: float, echo: bool
) -> None:
    """Answer loads over HTTP and tools in sessions.

    Prints a request to try once every model is loaded and warm.
    """
    if not any(artifacts.glob("*.h5")):
        raise PalpateError(
            f"no artifacts (*.h5) in {artifacts}; make one with: "
            f"palpate train turbinate --out {artifacts / 'turbinate.h5'}"
        )
    import uvicorn

    from online.app import create_app
    from online.settings import Settings
    from online.websocket import OPTIONS

    logging.basicConfig(level=logging.INFO, format="%(levelname)s: %(message)s")
    settings = Settings(artifacts, max_sessions=max_sessions, session_idle=session_idle, echo=echo)
    config = uvicorn.Config(
        lambda: create_app(settings, on_ready=lambda store: _invite(store, url)),
        factory=True,
        host=host,
        port=port,
        access_log=False,
        log_level="warning",
        **OPTIONS,
    )
    bound = config.bind_socket()
    url = f"http://{f'[{host}]' if ':' in host else host}:{bound.getsockname()[1]}"
    # The server shuts down on a signal and then raises it again, for us to end cleanly.
    for stop in (signal.SIGTERM, signal.SIGINT):
        signal.signal(stop, lambda *_: sys.exit(0))
    uvicorn.Server(config).run(sockets=[bound])


def _invite(store: "Store", url: str) -> None:
    """Print what is served and a request to try."""
    for refused in store.refused:
        click.echo(f"Refused {refused.reason}")
    click.echo(f"Serving {', '.join(store.models) or 'nothing'} on {url} (API: {url}/docs)")
    for name, model in store.models.items():
        click.echo(
            f"Try: curl {url}/scenes/{name}/solve -H 'Content-Type: application/json' "
            f"-d '{json.dumps({'contacts': [model.example]})}'"
        )
        break


@click.command()
@click.argument("url")
@click.argument("scene")
@click.option("--rounds", type=click.IntRange(min=1), default=3000, show_default=True)
@click.option("--session", is_flag=True, help="Measure the steps of a session; needs an --echo.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def latency(url: str, scene: str, rounds: int, session: bool, as_json: bool) -> None:
    """Measure what a running service at URL adds to a solve of SCENE.

    Medians in µs over ROUNDS turns of an empty request, a solve without fields and one with all
    fields in binary. The ratios are what is left of a round trip without the solve (and the
    recovery of the fields), over the empty one.

    With --session: over turns of a step of a session and an echo of frames of the same sizes,
    which a service started with --echo gives. The ratio is what is left of a step without its
    solve, over the echo.
    """
    from online.latency import measure, measure_session

    report = (measure_session if session else measure)(url, scene, rounds)
    if as_json:
        click.echo(json.dumps(report))
        return
    for name, value in report.items():
        click.echo(f"{name:<16}{value:8.2f}")


@click.command()
@click.argument("recording", type=click.Path(dir_okay=False, path_type=Path))
@click.argument("artifact", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def replay(recording: Path, artifact: Path, as_json: bool) -> None:
    """Answer a recorded session anew and compare, bit for bit.

    RECORDING is what a client of a session wrote (`record=` of online.client); ARTIFACT the one
    that was served. The exit code is 1 if any reply differs. The same answers to the bit need the
    same kind of processor and the same versions of the libraries.
    """
    from online.recording import read_recording
    from online.replay import replay
    from shared.atlas import Atlas

    report = replay(read_recording(recording), Atlas.load(artifact))._asdict()
    if as_json:
        click.echo(json.dumps(report))
    else:
        for name, value in report.items():
            click.echo(f"{name:<18}{'-' if value is None else value}")
    if report["different"]:
        raise click.exceptions.Exit(1)
