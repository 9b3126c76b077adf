"""The online commands; each imports what it runs when it runs, so that ``--help`` is instant."""

import json
from pathlib import Path
from typing import Any

import click

from palpate.online.settings import Plan, Settings, options

_SERVE_EXAMPLES = """\b
Examples:
  palpate serve --artifacts artifacts --realtime
  PALPATE_TOKEN=$(openssl rand -hex 32) palpate serve --host 0.0.0.0 --workers 2
"""

_DEMO_EXAMPLES = """\b
Examples:
  palpate demo
  palpate demo quick-visco
  palpate demo --beside turbinate --port 8080
"""

_LOADTEST_EXAMPLES = """\b
Examples:
  palpate loadtest http://127.0.0.1:8000 --sessions 4 --queries-per-second 20
  palpate loadtest http://127.0.0.1:8000 --sessions 0 --queries-per-second 200 --region none
  palpate loadtest http://127.0.0.1:8000 --sessions 4 --overload 10 --out overload.png
  palpate loadtest http://127.0.0.1:8000 --rate 200 --queries-per-second 50 --echo
"""


@click.command(epilog=_SERVE_EXAMPLES, context_settings={"auto_envvar_prefix": "PALPATE"})
@options(Settings)
def serve(**settings: Any) -> None:
    """Answer loads over HTTP and in sessions.

    Prints the address of its page and a request to try once every model is loaded and warm. Every
    option can also be set by the variable named beside it. On loopback anybody on this machine is
    served; on any other address a token is asked for, unless --public says not to.
    """
    from palpate.online.serve.process import serve

    serve(Settings(**settings))


@click.command(epilog=_DEMO_EXAMPLES, context_settings={"auto_envvar_prefix": "PALPATE"})
@click.argument("scene", default="pad")
@click.option(
    "--beside",
    multiple=True,
    metavar="SCENE",
    show_envvar=True,
    help="Train this scene meanwhile; it is served as soon as it is there. May be repeated.",
)
@click.option(
    "--browser/--no-browser", default=True, show_default=True, show_envvar=True,
    help="Open the page.",
)  # fmt: skip
@options(Settings)
def demo(scene: str, beside: tuple[str, ...], browser: bool, **settings: Any) -> None:
    """Press a first piece of tissue: serve SCENE, trained if needed, and open its page.

    The small pad that is served without SCENE comes trained with Palpate.

    The other options are those of palpate serve.
    """
    from palpate.online.demo import demo

    demo(Settings(**settings), scene, beside, browser)


@click.command(epilog=_LOADTEST_EXAMPLES)
@click.argument("url")
@click.argument("scene", default="turbinate")
@options(Plan)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="PNG of latency over time and of its distribution.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def loadtest(out: Path | None, as_json: bool, **plan: Any) -> None:
    """Put a load on the service at URL and time it from when each message was due.

    Sessions move a tip over the whole accessible surface of SCENE at up to 50 mm/s, in and out of
    contact; queries press random places. A generator that never sleeps sends each message when it
    is due, whatever became of those before. Windows of 0.25 s in which the machine's host took
    time or the generator was late are not clean; latencies are given with and without them. For
    Linux and macOS.
    """
    from palpate.online.loadtest.run import draw, run, table

    outcome = run(Plan(**plan))
    click.echo(json.dumps(outcome.summary) if as_json else table(outcome.summary))
    if out is not None:
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
    from palpate.online.session.tracker import replay
    from palpate.shared.model import ReducedModel

    report = replay(read_recording(recording), ReducedModel.load(artifact))
    if as_json:
        click.echo(json.dumps(report))
    else:
        for name, value in report.items():
            click.echo(f"{name:<18}{'-' if value is None else value}")
    if report["different"]:
        raise click.exceptions.Exit(1)
