"""The online commands; each imports what it runs when it runs, so that ``--help`` is instant."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import click

from palpate.online.serve.logs import FORMATS, LEVELS
from palpate.online.serve.settings import Settings

_option = partial(click.option, show_default=True, show_envvar=True)

_SERVE_EXAMPLES = """\b
Examples:
  palpate serve --artifacts artifacts --realtime
  PALPATE_TOKEN=$(openssl rand -hex 32) palpate serve --host 0.0.0.0 --workers 2
"""

_LOADTEST_EXAMPLES = """\b
Examples:
  palpate loadtest http://127.0.0.1:8000 --sessions 4 --queries-per-second 20
  palpate loadtest http://127.0.0.1:8000 --sessions 0 --queries-per-second 200 --region none
  palpate loadtest http://127.0.0.1:8000 --sessions 4 --overload 10 --out overload.png
  palpate loadtest http://127.0.0.1:8000 --rate 200 --queries-per-second 50 --echo
"""


@click.command(epilog=_SERVE_EXAMPLES, context_settings={"auto_envvar_prefix": "PALPATE"})
@_option(
    "--artifacts",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("artifacts"),
    help="Directory whose *.h5 are served.",
)
@_option("--host", default="127.0.0.1", help="Address to listen on.")
@_option("--port", type=click.IntRange(0, 65535), default=8000, help="0 takes a free one.")
@_option(
    "--workers",
    type=click.IntRange(1, 64),
    default=1,
    help="Processes that share the work, each with the models in memory. A session stays with the "
    "worker that opened it; limits hold per worker; one that dies is replaced.",
)
@_option(
    "--realtime/--no-realtime",
    default=False,
    help="Run before the machine's ordinary work and stay in memory, if the system allows it; the "
    "log says whether it does.",
)
@_option(
    "--token",
    show_default=False,
    help="What clients must present, as Authorization: Bearer TOKEN. Rather set the variable: "
    "the command line is there for all to read.",
)
@_option(
    "--public/--no-public", default=False, help="Serve other machines even though no token is set."
)
@_option(
    "--origin",
    "origins",
    multiple=True,
    envvar="PALPATE_ORIGINS",
    show_default=False,
    help="Origin whose web pages may use the service, such as https://example.org, or * for any; "
    "may be repeated (in the variable: separated by spaces). Its own pages always may.",
)
@_option(
    "--rate-limit",
    type=click.FloatRange(0),
    default=Settings.rate_limit,
    help="Requests per second and client address; more are refused. As many may come at once after "
    "a pause; of a session only the opening counts. 0: no limit.",
)
@_option(
    "--max-wait",
    type=click.FloatRange(0.001),
    default=Settings.max_wait,
    help="Seconds after which a waiting request is refused rather than answered late.",
)
@_option(
    "--max-body",
    type=click.IntRange(1024),
    default=Settings.max_body,
    help="Most bytes of a request; a query needs some hundred.",
)
@_option(
    "--max-json-numbers",
    type=click.IntRange(0),
    default=Settings.max_json_numbers,
    help="Most numbers in a JSON answer's fields, each of which keeps others waiting for 25 ns; "
    "the binary formats have no such limit.",
)
@_option(
    "--max-sessions",
    type=click.IntRange(0),
    default=Settings.max_sessions,
    help="Most sessions at a time; further ones are refused.",
)
@_option(
    "--session-idle",
    type=click.FloatRange(0.1),
    default=Settings.session_idle,
    help="Seconds after which a session that sends nothing is closed.",
)
@_option("--echo/--no-echo", default=False, help="Answer /echo, for palpate loadtest --echo.")
@_option("--log-format", type=click.Choice(FORMATS), default=Settings.log_format)
@_option("--log-level", type=click.Choice(LEVELS), default=Settings.log_level)
@_option("--access-log/--no-access-log", default=False, help="Log every request.")
def serve(host: str, port: int, public: bool, **settings: Any) -> None:
    """Answer loads over HTTP and in sessions.

    Prints a request to try once every model is loaded and warm. Every option can also be set by
    the variable named beside it. On loopback anybody on this machine is served; on any other
    address a token is asked for, unless --public says not to.
    """
    from palpate.online.serve.process import serve

    serve(Settings(**settings), host, port, public)


@click.command(epilog=_LOADTEST_EXAMPLES)
@click.argument("url")
@click.argument("scene", default="turbinate-tip")
@_option("--sessions", type=click.IntRange(0), default=1, help="Tools at once.")
@_option(
    "--rate",
    type=click.FloatRange(1, 100_000),
    default=1000.0,
    help="Frames per second of each session.",
)
@_option(
    "--output",
    "outputs",
    multiple=True,
    type=click.Choice(["coordinates", "displacement", "von_mises", "stress", "half"]),
    help="What frames ask for beyond force and tangent; may be repeated.",
)
@_option(
    "--queries-per-second",
    "queries",
    type=click.FloatRange(0, 100_000),
    default=0.0,
    help="Solves over HTTP, in all, with fields in binary.",
)
@_option(
    "--region",
    type=click.Choice(["none", "surface", "all"]),
    default="all",
    help="Nodes that queries ask fields for.",
)
@_option(
    "--connections",
    type=click.IntRange(1, 1000),
    default=4,
    help="Connections that queries share.",
)
@_option("--duration", type=click.FloatRange(0.5), default=10.0, help="s")
@_option(
    "--overload",
    type=click.FloatRange(1),
    default=1.0,
    help="Multiply the rates for a second DURATION, go back to them for a third, and say how soon "
    "all is as before.",
)
@_option("--depth", type=click.FloatRange(0), default=1.0, help="How deep the tools press, mm.")
@_option(
    "--echo",
    is_flag=True,
    help="Measure what the service adds to a solve, too: send as many frames again that are only "
    "echoed (by a service started with --echo), and as many queries that are only checked.",
)
@_option("--seed", type=int, default=0, help="Of the paths.")
@_option("--token", envvar="PALPATE_TOKEN")
@_option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="PNG of latency over time and of its distribution.",
)
@_option("--json", "as_json", is_flag=True, help="Print JSON.")
def loadtest(outputs: tuple[str, ...], out: Path | None, as_json: bool, **plan: Any) -> None:
    """Put a load on the service at URL and time it from when each message was due.

    Sessions move a tip over the whole accessible surface of SCENE at up to 50 mm/s, in and out of
    contact; queries press random places. A generator that never sleeps sends each message when it
    is due, whatever became of those before. Windows of 0.25 s in which the machine's host took
    time or the generator was late are not clean; latencies are given with and without them. For
    Linux and macOS.
    """
    from palpate.online.loadtest.report import table
    from palpate.online.loadtest.run import Plan, run
    from palpate.online.session.frames import Output

    outcome = run(Plan(**plan, outputs=sum(Output[name.upper()] for name in outputs)))
    click.echo(json.dumps(outcome.summary) if as_json else table(outcome.summary))
    if out is not None:
        from palpate.online.loadtest.picture import draw

        draw(outcome, out)


@click.command()
@click.argument("recording", type=click.Path(dir_okay=False, path_type=Path))
@click.argument("artifact", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def replay(recording: Path, artifact: Path, as_json: bool) -> None:
    """Answer a recorded session again and compare, bit for bit.

    RECORDING is what a client of a session wrote (`record=` of client.http); ARTIFACT the one
    that was served. The exit code is 1 if any reply differs. The same answers to the bit need the
    same kind of processor, the same versions of the libraries, and a server that had its kernels
    compiled before it was started.
    """
    from palpate.online.session.recording import read_recording
    from palpate.online.session.replay import replay
    from palpate.shared.model import ReducedModel

    report = replay(read_recording(recording), ReducedModel.load(artifact))._asdict()
    if as_json:
        click.echo(json.dumps(report))
    else:
        for name, value in report.items():
            click.echo(f"{name:<18}{'-' if value is None else value}")
    if report["different"]:
        raise click.exceptions.Exit(1)
