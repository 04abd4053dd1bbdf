import json

import pytest

from neurove_service.models.active_file import Active, ActiveFile

KEPT = Active(digest="5e" * 32, previous=None, configured="default", highest_release=7)


def test_what_is_kept_is_there_after_a_restart(tmp_path):
    assert ActiveFile(tmp_path).active is None
    assert ActiveFile(tmp_path / "new").keep(KEPT)
    again = ActiveFile(tmp_path / "new")
    assert (again.active, again.highest_release) == (KEPT, 7)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["active.json"]


@pytest.mark.parametrize("seed", range(0, 200, 13))
def test_one_flipped_bit_anywhere_is_noticed(tmp_path, seed):
    ActiveFile(tmp_path).keep(KEPT)
    file = tmp_path / "active.json"
    data = bytearray(file.read_bytes())
    data[seed] ^= 1 << seed % 7
    file.write_bytes(data)
    found = ActiveFile(tmp_path).active
    assert found is None or found == KEPT  # equal where the bit was of white space


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "5", '{"version": 2}', '{"version": 1}', "[" * 5000])
def test_a_broken_file_is_as_good_as_none(tmp_path, text):
    (tmp_path / "active.json").write_text(text)
    assert ActiveFile(tmp_path).active is None


def test_every_truncation_is_noticed(tmp_path):
    ActiveFile(tmp_path).keep(KEPT)
    whole = (tmp_path / "active.json").read_bytes()
    for length in range(len(whole) - 2):
        (tmp_path / "active.json").write_bytes(whole[:length])
        assert ActiveFile(tmp_path).active is None


def test_a_checksum_that_fits_a_record_that_does_not_is_refused(tmp_path):
    ActiveFile(tmp_path).keep(KEPT)
    told = json.loads((tmp_path / "active.json").read_text())
    wrong = Active.model_construct(**told["active"] | {"digest": "../../etc"})
    ActiveFile(tmp_path).keep(wrong)
    assert ActiveFile(tmp_path).active is None


def test_without_a_place_to_write_a_change_still_holds_until_the_end(tmp_path):
    (tmp_path / "file").write_text("no folder")
    for folder in (None, tmp_path / "file"):
        kept = ActiveFile(folder)
        assert not kept.keep(KEPT)
        assert kept.highest_release == 7
