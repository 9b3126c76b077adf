"""What can be set of the service and of its load test: fields here, options of the commands."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import click

from palpate.shared.cli import Finite


def _option(default: Any, help: str | None = None, type: Any = None, **more: Any) -> Any:
    """Make a field that is an option as well; its `flag` is by default the field's name."""
    return field(default=default, metadata={"help": help, "type": type, **more})


@dataclass(frozen=True)
class Settings:
    """Settings of one service.

    `hosts` are names that clients may call the service by, besides loopback; any, if empty.
    """

    artifacts: Path = _option(
        Path("artifacts"),
        "Directory whose *.h5 are served.",
        click.Path(file_okay=False, path_type=Path),
    )
    host: str = _option("127.0.0.1", "Address to listen on.")
    port: int = _option(8000, "0 takes a free one.", click.IntRange(0, 65535))
    workers: int = _option(
        1,
        "Processes that share the work and the models in memory. A session stays with the "
        "worker that opened it; limits hold per worker; one that dies is replaced.",
        click.IntRange(1, 64),
    )
    realtime: bool = _option(
        False,
        "Run before the machine's ordinary work and stay in memory, if the system allows it; the "
        "log says whether it does.",
    )
    token: str | None = _option(
        None,
        "What clients must present, as Authorization: Bearer TOKEN. Rather set the variable: "
        "the command line is there for all to read.",
    )
    public: bool = _option(False, "Serve other machines even though no token is set.")
    origins: tuple[str, ...] = _option(
        (),
        "Origin whose web pages may use the service, such as https://example.org, or * for any; "
        "may be repeated (in the variable: separated by spaces). Its own pages always may.",
        flag="--origin",
        multiple=True,
        envvar="PALPATE_ORIGINS",
    )
    proxy: str | None = _option(
        None,
        "Address of a proxy that is believed who its clients are (X-Forwarded-For); none is.",
    )
    rate_limit: float = _option(
        2000.0,
        "Requests per second and client address; more are refused. As many may come at once after "
        "a pause; of a session only the opening counts. 0: no limit.",
        Finite(0),
    )
    max_wait: float = _option(
        0.1,
        "Seconds after which a waiting request is refused rather than answered late.",
        Finite(0.001),
    )
    max_body: int = _option(
        64 * 1024, "Most bytes of a request; a query needs some hundred.", click.IntRange(1024)
    )
    max_json_numbers: int = _option(
        100_000,
        "Most numbers in a JSON answer's fields, each of which keeps others waiting for 25 ns; "
        "the binary formats have no such limit.",
        click.IntRange(0),
    )
    max_sessions: int = _option(
        16, "Most sessions at a time; further ones are refused.", click.IntRange(0)
    )
    session_idle: float = _option(
        60.0, "Seconds after which a session that sends nothing is closed.", Finite(0.1)
    )
    echo: bool = _option(False, "Answer /echo, for palpate loadtest --echo.")
    log_format: str = _option("json", type=click.Choice(["json", "text"]))
    log_level: str = _option("info", type=click.Choice(["debug", "info", "warning", "error"]))
    access_log: bool = _option(False, "Log every request.")
    hosts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What a load test puts on a service."""

    url: str
    scene: str
    sessions: int = _option(1, "Tools at once.", click.IntRange(0))
    rate: float = _option(1000.0, "Frames per second of each session.", Finite(1, 100_000))
    outputs: tuple[str, ...] = _option(
        (),
        "What frames ask for beyond force and tangent; may be repeated.",
        click.Choice(["coordinates", "displacement", "von_mises", "stress", "half"]),
        flag="--output",
        multiple=True,
    )
    queries: float = _option(
        0.0,
        "Solves over HTTP, in all, with fields in binary.",
        Finite(0, 100_000),
        flag="--queries-per-second",
    )
    region: str = _option(
        "all", "Nodes that queries ask fields for.", click.Choice(["none", "surface", "all"])
    )
    connections: int = _option(4, "Connections that queries share.", click.IntRange(1, 1000))
    duration: float = _option(10.0, "s", Finite(0.5))
    overload: float = _option(
        1.0,
        "Multiply the rates for a second DURATION, go back to them for a third, and say how soon "
        "all is as before.",
        Finite(1),
    )
    depth: float = _option(1.0, "How deep the tools press, mm.", Finite(0))
    echo: bool = _option(
        False,
        "Measure what the service adds to a solve, too: send as many frames again that are only "
        "echoed (by a service started with --echo), and as many queries that are only checked.",
    )
    seed: int = _option(0, "Of the paths.")
    token: str | None = _option(None, envvar="PALPATE_TOKEN")


def options(kind: type) -> Callable[[Any], Any]:
    """Decorate a function with the options of `Settings` or of a `Plan`."""

    def decorate(function: Any) -> Any:
        for setting in reversed(fields(kind)):
            if given := dict(setting.metadata):
                name = setting.name.replace("_", "-")
                flag = f"--{name}/--no-{name}" if setting.type is bool else f"--{name}"
                flag = given.pop("flag", flag)
                given |= {"default": setting.default, "show_default": True, "show_envvar": True}
                function = click.option(flag, setting.name, **given)(function)
        return function

    return decorate
