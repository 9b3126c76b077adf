import json
import logging

import pytest

from palpate.online.serve import logs
from palpate.online.serve.settings import Settings


@pytest.fixture
def root():
    """Give the root logger back as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:] = handlers
    root.setLevel(level)


def test_a_record_is_one_line_of_json(root, tmp_path, capsys):
    logs.set_up(Settings(tmp_path))
    try:
        raise ValueError("no\nway")
    except ValueError:
        logging.getLogger("palpate.test").exception("it failed: %s", "twice")
    logging.getLogger("palpate.test").debug("too much detail")
    (line,) = capsys.readouterr().err.splitlines()
    record = json.loads(line)
    assert record["level"] == "error"
    assert record["logger"] == "palpate.test"
    assert record["message"] == "it failed: twice"
    assert "ValueError" in record["exception"]


def test_text_and_level_can_be_chosen(root, tmp_path, capsys):
    logs.set_up(Settings(tmp_path, log_format="text", log_level="error"))
    logging.getLogger("palpate.test").warning("quiet")
    logging.getLogger("palpate.test").error("loud")
    assert capsys.readouterr().err == "ERROR: loud\n"
