import json

import pytest
from click.testing import CliRunner

from palpate.online.commands import latency
from palpate.online.loadtest.latency import measure, measure_session
from palpate.online.serve.settings import Settings
from palpate.shared.errors import PalpateError

from ..fake_model import FakeModel


def test_what_the_service_adds_is_told_apart_from_the_solve(url):
    report = measure(url, "toy", rounds=50)
    assert report["solve_added_us"] < report["solve_us"]
    assert report["fields_added_us"] < report["fields_us"]
    assert report["solve_ratio"] == pytest.approx(report["solve_added_us"] / report["empty_us"])
    assert report["fields_ratio"] == pytest.approx(report["fields_added_us"] / report["empty_us"])


def test_the_command_prints_json(url):
    result = CliRunner().invoke(latency, [url, "toy", "--rounds", "5", "--json"])
    assert json.loads(result.output)["empty_us"] > 0


def test_what_a_session_adds_is_told_apart_from_the_solve(serving, tmp_path):
    with serving(Settings(tmp_path, echo=True), toy=FakeModel()) as url:
        report = measure_session(url, "toy", rounds=50)
    assert report["step_added_us"] < report["step_us"]
    assert report["step_ratio"] == pytest.approx(report["step_added_us"] / report["echo_us"])


def test_without_an_echo_a_session_cannot_be_measured(url):
    with pytest.raises(PalpateError, match="palpate serve --echo"):
        measure_session(url, "toy", rounds=1)


def test_it_presents_a_token(serving, tmp_path):
    with serving(Settings(tmp_path, echo=True, token="secret"), toy=FakeModel()) as url:
        arguments = [url, "toy", "--rounds", "2", "--json"]
        for more in ([], ["--session"]):
            refused = CliRunner().invoke(latency, [*arguments, *more])
            assert isinstance(refused.exception, PalpateError)
            result = CliRunner().invoke(latency, [*arguments, *more, "--token", "secret"])
            assert result.exit_code == 0, result.output
