import shutil

import pytest

from protocol.errors import BadModel, UnknownModel
from service.model_slot import ModelSlot


def test_a_model_is_found_by_name_and_by_digest(slot):
    before, serving = slot.activate("two")
    assert (before.name, serving.estimator.bundle.name, serving.epoch) == ("one", "two", 1)
    digest = before.digest
    assert slot.activate(digest[:8])[1].estimator.bundle.name == "one"
    assert slot.previous.name == "two"


def test_an_unknown_model_changes_nothing_and_says_what_there_is(slot):
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
    (tmp_path / "text.safetensors").write_text("hello, I am no model at all")
    slot = ModelSlot("one", tmp_path)
    assert slot.available().unreadable.keys() == {"two.safetensors", "text.safetensors"}
    before = slot.active
    with pytest.raises(BadModel, match=r"two\.safetensors: "):
        slot.activate("two")
    assert slot.active is before


def test_two_models_of_one_name_must_be_told_apart_by_digest(models_dir, tmp_path):
    from neurove_core import bundle

    shutil.copytree(models_dir, tmp_path, dirs_exist_ok=True)
    twin = bundle.load(models_dir / "one.safetensors")
    bundle.save(bundle.untrained(9, twin.config, "two"), tmp_path / "other.safetensors")
    slot = ModelSlot("one", tmp_path)
    with pytest.raises(BadModel, match="2 models have this name"):
        slot.activate("two")


def test_the_model_given_at_the_start_stays_available_without_a_folder(models_dir):
    slot = ModelSlot(str(models_dir / "one.safetensors"))
    slot.activate("untrained")
    assert slot.activate("one")[1].epoch == 2
    with pytest.raises(BadModel, match="No such file"):
        ModelSlot(str(models_dir / "none.safetensors"))
