import json

import pytest
from click.testing import CliRunner

from online.commands import latency
from online.latency import measure


def test_what_the_service_adds_is_told_apart_from_the_solve(url):
    report = measure(url, "toy", rounds=50)
    assert report["solve_added_us"] < report["solve_us"]
    assert report["fields_added_us"] < report["fields_us"]
    assert report["solve_ratio"] == pytest.approx(report["solve_added_us"] / report["empty_us"])
    assert report["fields_ratio"] == pytest.approx(report["fields_added_us"] / report["empty_us"])


def test_the_command_prints_json(url):
    result = CliRunner().invoke(latency, [url, "toy", "--rounds", "5", "--json"])
    assert json.loads(result.output)["empty_us"] > 0
