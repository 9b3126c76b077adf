import errno
import os
import subprocess
import sys
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from palpate.shared import cli
from palpate.shared.errors import PalpateError, QueryError

COMMANDS = ["bench", "info", "scene", "serve", "solve", "study", "train", "validate"]


@pytest.fixture
def run():
    def run(*arguments):
        return CliRunner().invoke(cli.main, list(arguments))

    return run


def test_help_lists_every_command_and_an_example(run):
    result = run("--help")
    assert result.exit_code == 0
    for command in COMMANDS:
        assert f"\n  {command} " in result.output
    assert "palpate solve pad --at" in result.output


@pytest.mark.parametrize(
    ("arguments", "exit_code", "said"),
    [
        *(([command, "--help"], 0, f"Usage: palpate {command}") for command in COMMANDS),
        (["--version"], 0, "palpate, version 0."),
        (["knead"], 2, "No such command 'knead'"),
        (["serve", "--rate-limit", "nan"], 2, "nan is not a finite number"),
        (["serve", "--port", "99999"], 2, "99999 is not in the range"),
        (["serve", "--max-wait", "-1"], 2, "-1.0 is not in the range"),
        (["loadtest", "http://127.0.0.1:1", "--rate", "nan"], 2, "nan is not a finite number"),
        (["loadtest", "http://127.0.0.1:1"], 2, "http://127.0.0.1:1: no service answers there"),
    ],
)
def test_commands_explain_themselves_and_others_are_refused(run, arguments, exit_code, said):
    result = run(*arguments)
    assert result.exit_code == exit_code
    assert said in result.output


def test_our_errors_are_one_line_and_show_their_origin_when_asked(run, monkeypatch):
    def fail():
        raise QueryError("pressure", "must be 0 to 9 kPa, not -1")

    entry = SimpleNamespace(load=lambda: click.Command("fail", callback=fail))
    monkeypatch.setattr(cli, "entry_points", lambda **_: [entry])
    monkeypatch.delenv("PALPATE_DEBUG", raising=False)
    result = run("fail")
    assert result.exit_code == 2
    assert result.output == "Error: pressure: must be 0 to 9 kPa, not -1\n"
    monkeypatch.setenv("PALPATE_DEBUG", "1")
    assert isinstance(run("fail").exception, PalpateError)


def test_who_reads_no_more_of_what_is_printed_is_told_nothing(run, monkeypatch):
    def fail():
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    entry = SimpleNamespace(load=lambda: click.Command("fail", callback=fail))
    monkeypatch.setattr(cli, "entry_points", lambda **_: [entry])
    assert run("fail").output == ""


HIDE = """
import sys
for name in ("tqdm", "matplotlib", "pyvista", "mkl"):
    sys.modules[name] = None  # as if it were not installed
from palpate.shared.cli import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("train quick", "Error: this needs tqdm: pip install 'palpate[train]'"),
        ("picture A --at 4 5 8 --pressure 1 --out x.png", "'palpate[pictures]'"),
        ("info A", "scene          quick"),
        ("solve A --at 4 5 8 --pressure 1 --json", '{"scene":"quick"'),
        ("scene quick", 'name = "quick"'),
        ("serve --artifacts nowhere", "no artifacts (*.h5) in nowhere"),
    ],
)
def test_what_serves_and_asks_runs_without_extras_and_the_rest_names_its_own(
    artifact, tmp_path, command, said
):
    words = [str(artifact) if word == "A" else word for word in command.split()]
    run = subprocess.run(
        [sys.executable, "-c", HIDE, *words], cwd=tmp_path, capture_output=True, text=True
    )
    assert said in run.stdout + run.stderr
    assert "Traceback" not in run.stderr


def printed(script, **environment):
    """What a script prints, in words."""
    run = subprocess.run(
        [sys.executable, "-c", script],
        env={k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | environment,
        capture_output=True, check=True,
    )  # fmt: skip
    return run.stdout.decode().split()


def test_whatever_imports_the_software_runs_on_one_blas_thread():
    threads = "(os.environ[f'{name}_NUM_THREADS'] for name in ('OPENBLAS', 'MKL'))"
    assert printed(f"import os, shared; print(*{threads})", MKL_NUM_THREADS="2") == ["1", "2"]


@pytest.mark.parametrize(
    ("script", "heavy"),
    [
        (
            "from click.testing import CliRunner; from palpate.shared.cli import main\n"
            "CliRunner().invoke(main, ['--help'])",
            ["numpy", "numba", "fastapi", "h5py"],
        ),
        (
            "import palpate.online.serve.app",
            ["felupe", "matplotlib", "palpate.offline", "pyvista", "scipy.sparse.linalg", "tqdm"],
        ),
        (
            "from palpate import Client, Flag, Output, PalpateError, ServiceError, Session\n"
            "from palpate import SessionClosed",
            ["fastapi", "pydantic", "h5py", "numba", "starlette", "orjson", "msgpack"],
        ),
    ],
    ids=["help", "server", "client"],
)
def test_nothing_is_imported_that_is_not_needed(script, heavy):
    assert printed(f"{script}\nimport sys; print(*set({heavy}) & sys.modules.keys())") == []
