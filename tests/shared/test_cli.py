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
    assert "palpate solve quick --at" in result.output


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself(run, command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert result.output.startswith(f"Usage: palpate {command}")


def test_version(run):
    assert run("--version").output.startswith("palpate, version 0.")


def test_unknown_command_is_refused(run):
    result = run("knead")
    assert result.exit_code == 2
    assert "No such command 'knead'" in result.output


@pytest.fixture
def failing_command(monkeypatch):
    def fail():
        raise QueryError("pressure", "must be 0 to 9 kPa, not -1")

    entry = SimpleNamespace(load=lambda: click.Command("fail", callback=fail))
    monkeypatch.setattr(cli, "entry_points", lambda **_: [entry])


@pytest.mark.usefixtures("failing_command")
def test_our_errors_are_one_line(run, monkeypatch):
    monkeypatch.delenv("PALPATE_DEBUG", raising=False)
    result = run("fail")
    assert result.exit_code == 2
    assert result.output == "Error: pressure: must be 0 to 9 kPa, not -1\n"


@pytest.mark.usefixtures("failing_command")
def test_our_errors_show_their_origin_when_asked(run, monkeypatch):
    monkeypatch.setenv("PALPATE_DEBUG", "1")
    assert isinstance(run("fail").exception, PalpateError)


def test_whatever_imports_the_software_runs_on_one_blas_thread():
    script = (
        "import os, shared\n"
        "print(*(os.environ[f'{name}_NUM_THREADS'] for name in ('OPENBLAS', 'MKL')))"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    output = subprocess.run(
        [sys.executable, "-c", script],
        env=environment | {"MKL_NUM_THREADS": "2"}, capture_output=True, check=True,
    )  # fmt: skip
    assert output.stdout.decode().split() == ["1", "2"]


def test_help_is_quick():
    """Nothing that computes is imported just to print a help text."""
    script = (
        "import sys; from click.testing import CliRunner; from palpate.shared.cli import main\n"
        "CliRunner().invoke(main, ['--help'])\n"
        "print(*{'numpy', 'numba', 'fastapi', 'h5py'} & sys.modules.keys())"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert output.stdout.decode().split() == []
