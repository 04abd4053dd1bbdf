import shutil
import threading

import pytest

from neurove_protocol.errors import BadModel, Conflict, NothingBefore, UnknownModel
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from tests.service.models.swapping import wait_until


def test_a_model_is_found_by_name_and_by_digest(slot):
    before, serving = slot.activate("two")
    assert (before.name, serving.estimator.bundle.name, serving.epoch) == ("one", "two", 1)
    digest = before.digest
    assert slot.activate(digest[:8])[1].estimator.bundle.name == "one"
    assert slot.previous.name == "two"


def test_an_unknown_model_changes_nothing_and_the_error_lists_the_available_ones(slot):
    before = slot.active
    with pytest.raises(UnknownModel, match="model='three'.*available: default, untrained, one, two"):
        slot.activate("three")
    assert slot.active is before


@pytest.mark.parametrize("name", ["../one", "/etc/passwd", "one.safetensors", "*"])
def test_a_name_from_the_network_is_never_a_path(slot, name):
    with pytest.raises(UnknownModel):
        slot.activate(name)


def test_a_broken_bundle_is_listed_with_its_reason_and_refused(models_dir, tmp_path):
    shutil.copytree(models_dir, tmp_path, dirs_exist_ok=True)
    data = (tmp_path / "two.safetensors").read_bytes()
    (tmp_path / "two.safetensors").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.safetensors").write_text("hello, I am not a model")
    slot = ModelSlot("one", tmp_path)
    assert slot.available().unreadable.keys() == {"two.safetensors", "text.safetensors"}
    before = slot.active
    with pytest.raises(BadModel, match=r"two\.safetensors: "):
        slot.activate("two")
    assert slot.active is before


def test_two_models_of_one_name_need_a_digest(models_dir, tmp_path):
    from neurove_core.models import bundle

    shutil.copytree(models_dir, tmp_path, dirs_exist_ok=True)
    one = bundle.load(models_dir / "one.safetensors")
    bundle.save(bundle.untrained(9, one.config, "two"), tmp_path / "other.safetensors")
    slot = ModelSlot("one", tmp_path)
    with pytest.raises(BadModel, match="2 models have this name"):
        slot.activate("two")


def test_the_model_given_at_the_start_stays_available_without_a_folder(models_dir):
    slot = ModelSlot(str(models_dir / "one.safetensors"))
    slot.activate("untrained")
    assert slot.activate("one")[1].epoch == 2
    with pytest.raises(BadModel, match="No such file"):
        ModelSlot(str(models_dir / "none.safetensors"))


def test_a_change_during_another_change_is_a_conflict(slot):
    progress, began, go_on = [], threading.Event(), threading.Event()

    def first_step(_):
        began.set()
        assert go_on.wait(60)

    winner = threading.Thread(target=slot.activate, args=("two",), kwargs={"on_progress": first_step})
    winner.start()
    assert began.wait(60)
    with pytest.raises(Conflict, match="another model change is in progress"):
        slot.activate("untrained")
    with pytest.raises(Conflict):
        slot.rollback()
    go_on.set()
    winner.join()
    slot.activate("one", on_progress=progress.append)
    assert (slot.active.epoch, slot.previous.name) == (2, "two")
    steps = [one.step for one in progress]
    assert (steps[:3], steps[-2:]) == (["verified", "loaded", "warmed"], ["active", "probation"])


def test_a_change_that_expects_another_model_is_a_conflict_and_changes_nothing(slot):
    before = slot.active
    digest = before.estimator.bundle.digest
    for change in (lambda: slot.activate("two", expect="0" * 8), lambda: slot.rollback(expect="0" * 8)):
        with pytest.raises(Conflict, match=f"expected 00000000 to be active, but .* {digest} is active"):
            change()
    assert slot.active is before
    assert slot.activate("two", expect=digest[:8])[1].epoch == 1


def test_a_rollback_goes_back_once(slot):
    with pytest.raises(NothingBefore):
        slot.rollback()
    slot.activate("two")
    before, serving = slot.rollback()
    assert (before.name, serving.estimator.bundle.name, serving.epoch) == ("two", "one", 2)
    with pytest.raises(NothingBefore):
        slot.rollback()


def test_every_model_to_save_is_reported_with_the_previous_one(models_dir):
    saved = []
    slot = ModelSlot("one", models_dir, Rules(probation_s=0), lambda model: saved.append((model.name, slot.previous)))
    slot.activate("two")
    wait_until(lambda: saved)
    slot.rollback()
    assert [name for name, _ in saved] == ["two", "one"]
    assert [previous and previous.name for _, previous in saved] == ["one", None]


def test_the_last_active_model_takes_precedence_over_the_configured_one_if_it_can_be_loaded(models_dir, slot):
    two = slot.activate("two")[1].estimator.bundle.digest
    one = slot.previous.digest
    again = ModelSlot("one", models_dir, kept=(two, one))
    assert (again.active.estimator.bundle.name, again.previous.name) == ("two", "one")
    assert again.rollback()[1].estimator.bundle.name == "one"
    gone = ModelSlot("one", models_dir, kept=("0" * 64, "1" * 64))
    assert (gone.active.estimator.bundle.name, gone.previous) == ("one", None)
    assert ModelSlot("three", models_dir, kept=(two, None)).active.estimator.bundle.name == "two"
    with pytest.raises(UnknownModel):
        ModelSlot("three", models_dir, kept=("0" * 64, None))
