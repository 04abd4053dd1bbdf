import json

import pytest

from neurove_service.models.active_file import Active, ActiveFile

SAVED = Active(digest="5e" * 32, previous=None, configured="default", highest_release=7, trial="6e" * 32)


def test_a_saved_record_is_read_after_a_restart(tmp_path):
    assert ActiveFile(tmp_path).active is None
    assert ActiveFile(tmp_path / "new").keep(SAVED)
    again = ActiveFile(tmp_path / "new")
    assert (again.active, again.highest_release) == (SAVED, 7)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["active.json"]


def test_a_record_without_a_trial_is_one_of_an_earlier_version(tmp_path):
    fields = SAVED.model_dump(exclude={"trial"})
    assert Active.model_validate(fields).trial is None


@pytest.mark.parametrize("seed", range(0, 200, 13))
def test_a_flipped_bit_anywhere_is_detected(tmp_path, seed):
    ActiveFile(tmp_path).keep(SAVED)
    file = tmp_path / "active.json"
    data = bytearray(file.read_bytes())
    data[seed] ^= 1 << seed % 7
    file.write_bytes(data)
    found = ActiveFile(tmp_path).active
    assert found is None or found == SAVED  # equal if the bit was in white space


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "5", '{"version": 2}', '{"version": 1}', "[" * 5000])
def test_a_damaged_file_counts_as_no_file(tmp_path, text):
    (tmp_path / "active.json").write_text(text)
    assert ActiveFile(tmp_path).active is None


def test_every_truncation_is_detected(tmp_path):
    ActiveFile(tmp_path).keep(SAVED)
    whole = (tmp_path / "active.json").read_bytes()
    for length in range(len(whole) - 2):
        (tmp_path / "active.json").write_bytes(whole[:length])
        assert ActiveFile(tmp_path).active is None


def test_an_invalid_record_with_a_correct_checksum_is_refused(tmp_path):
    ActiveFile(tmp_path).keep(SAVED)
    saved = json.loads((tmp_path / "active.json").read_text())
    wrong = Active.model_construct(**saved["active"] | {"digest": "../../etc"})
    ActiveFile(tmp_path).keep(wrong)
    assert ActiveFile(tmp_path).active is None


def test_without_a_writable_folder_a_record_is_kept_in_memory(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    for folder in (None, tmp_path / "file"):
        kept = ActiveFile(folder)
        assert not kept.keep(SAVED)
        assert kept.highest_release == 7
