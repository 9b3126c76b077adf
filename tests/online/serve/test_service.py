import logging
import os
import time

import pytest

from palpate.online.serve.errors import Refusal
from palpate.online.serve.first_start import compile_kernels
from palpate.shared.errors import PalpateError
from palpate.shared.progress import FILE, SILENT, Progress, tell, training_folder

from ..fake_model import FakeModel


def ignore(model):
    pass


def put(path):
    """Write a file of another inode, as training does."""
    path.with_suffix(".part").write_bytes(b"new")
    path.with_suffix(".part").replace(path)


def test_what_fails_is_named_and_the_others_are_served(fake_service, caplog):
    caplog.set_level(logging.INFO)
    models = {
        "bug": KeyError("basis"),
        "foreign": PalpateError("foreign.h5: not an artifact"),
        "toy": FakeModel(),
    }
    service = fake_service(**models)
    service.open(ignore)
    assert list(service.models) == ["toy"]
    reasons = {refused["file"]: refused["reason"] for refused in service.refused}
    assert reasons["foreign.h5"] == "foreign.h5: not an artifact"
    assert "KeyError" in reasons["bug.h5"]
    for file in ("foreign.h5", "bug.h5", "toy.h5"):
        assert file in caplog.text


def test_a_name_is_served_once(fake_service):
    service = fake_service(first=FakeModel("toy"), second=FakeModel("toy"))
    service.open(ignore)
    assert [refused["file"] for refused in service.refused] == ["second.h5"]
    assert "another file already holds 'toy'" in service.refused[0]["reason"]


def test_nothing_is_given_out_before_all_are_ready(fake_service):
    service = fake_service(toy=FakeModel())
    service.open(ignore)
    with pytest.raises(Refusal, match="being loaded"):
        service.model("toy")
    service.ready.set()
    assert service.model("toy").model.name == "toy"


def test_a_model_that_fails_its_first_answers_is_refused(fake_service):
    def warm(model):
        raise Refusal("no_equilibrium", "contacts.0.pressure", "The answer is not finite")

    service = fake_service(toy=FakeModel())
    service.open(warm)
    assert "not finite" in service.refused[0]["reason"]


def test_a_file_that_is_added_replaced_or_removed_is_taken_up(fake_service, tmp_path):
    first, second = FakeModel("one"), FakeModel("one")
    models = {"one": first}
    service = fake_service(**models)
    service.open(ignore)
    service.ready.set()
    under_way = service.model("one")
    warmed = []

    put(tmp_path / "two.h5")
    service.look(warmed.append)  # whose loading fails: the fixture knows no such model
    assert [refused["file"] for refused in service.refused] == ["two.h5"]
    assert list(service.models) == ["one"]

    (tmp_path / "two.h5").unlink()
    service.look(warmed.append)
    assert service.refused == warmed == []
    assert service.model("one") is under_way

    service.loads["one"] = second
    put(tmp_path / "one.h5")
    service.look(warmed.append)
    assert service.model("one").model is second
    assert [served.model for served in warmed] == [second]
    assert under_way.model is first

    (tmp_path / "one.h5").unlink()
    service.look(warmed.append)
    with pytest.raises(Refusal, match="No such scene"):
        service.model("one")


def test_what_replaces_a_model_and_fails_leaves_it_served(fake_service, tmp_path):
    service = fake_service(one=FakeModel("one"))
    service.open(ignore)
    service.loads["one"] = PalpateError("one.h5: truncated")
    put(tmp_path / "one.h5")
    service.look(ignore)
    assert list(service.models) == ["one"]
    assert service.refused[0]["reason"] == "one.h5: truncated; 'one' is served as it was"
    service.loads["one"] = FakeModel("other")
    put(tmp_path / "one.h5")
    service.look(ignore)
    assert list(service.models) == ["other"]
    assert not service.refused


def test_a_name_that_comes_free_is_taken_by_the_next(fake_service, tmp_path):
    first, second = FakeModel("toy"), FakeModel("toy")
    service = fake_service(first=first, second=second)
    service.open(ignore)
    (tmp_path / "first.h5").unlink()
    service.look(ignore)
    assert service.models["toy"].model is second
    assert not service.refused


def test_a_file_that_is_as_it_was_is_not_read_again(fake_service, tmp_path):
    service = fake_service(toy=FakeModel(), broken=PalpateError("broken"))
    service.open(ignore)
    service.loads.clear()
    service.look(ignore)
    assert list(service.models) == ["toy"]
    assert len(service.refused) == 1


def test_a_directory_out_of_reach_takes_nothing_away(fake_service, tmp_path):
    service = fake_service(toy=FakeModel())
    service.open(ignore)
    tmp_path.rename(tmp_path.with_name("elsewhere"))
    service.look(ignore)
    assert list(service.models) == ["toy"]


def test_trainings_are_told_while_they_go_on(fake_service, tmp_path):
    service = fake_service(toy=FakeModel())
    service.open(ignore)
    assert service.trainings == []
    folder = training_folder(tmp_path / "other.h5")
    folder.mkdir()
    told = Progress("other", "local models", 3, 10, 0.4, 60.0)
    tell(folder, told)
    service.look(ignore)
    assert service.trainings == [told]
    (folder / FILE).write_text("[")
    service.look(ignore)
    assert service.trainings == []
    tell(folder, told)
    long_ago = time.time() - SILENT - 1.0
    os.utime(folder / FILE, (long_ago, long_ago))
    service.look(ignore)
    assert service.trainings == []


def test_a_link_to_nothing_keeps_no_first_start_from_compiling(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    (tmp_path / "gone.h5").symlink_to(tmp_path / "nothing")
    compile_kernels(tmp_path)
    compile_kernels(tmp_path / "nothing")
