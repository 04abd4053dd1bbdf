"""Atomic writes: a file has its new content or its old one."""

import pytest

from neurove_core.figures import blank_figure, save_figure
from neurove_core.files import atomic_path, move_folder, write_atomically
from neurove_protocol.errors import InvalidField


def test_a_file_keeps_its_old_content_until_all_is_written(tmp_path):
    file = tmp_path / "a.txt"
    write_atomically(file, b"before")
    with atomic_path(file) as part:
        part.write_bytes(b"after")
        assert file.read_bytes() == b"before"
    assert file.read_bytes() == b"after"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_failed_write_keeps_the_old_file_and_leaves_no_temporary_file(tmp_path, error):
    file = tmp_path / "a.txt"
    write_atomically(file, b"before")

    def stopped():
        with atomic_path(file) as part:
            part.write_bytes(b"aft")
            raise error

    with pytest.raises(error):
        stopped()
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_block_that_writes_nothing_raises_and_the_file_stays(tmp_path):
    file = tmp_path / "a.txt"
    write_atomically(file, b"before")
    with pytest.raises(FileNotFoundError), atomic_path(file):
        pass
    assert file.read_bytes() == b"before"


def test_a_folder_moves_completely_and_not_onto_one_that_has_files(tmp_path):
    for name in ("new", "used"):
        (tmp_path / name).mkdir()
        write_atomically(tmp_path / name / "a.txt", name.encode())
    with pytest.raises(OSError, match="not empty"):
        move_folder(tmp_path / "new", tmp_path / "used")
    assert (tmp_path / "used" / "a.txt").read_bytes() == b"used"
    move_folder(tmp_path / "new", tmp_path / "free")
    assert (tmp_path / "free" / "a.txt").read_bytes() == b"new"
    assert not (tmp_path / "new").exists()


def test_a_figure_has_the_same_bytes_each_time_and_a_failed_write_names_the_file(tmp_path):
    pytest.importorskip("matplotlib")

    def drawn():
        figure = blank_figure(2, 1)
        figure.add_subplot().plot([0, 1])
        return figure

    first = [file.read_bytes() for file in save_figure(drawn(), tmp_path / "a")]
    assert [file.read_bytes() for file in save_figure(drawn(), tmp_path / "a")] == first
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.png", "a.svg"]
    with pytest.raises(InvalidField, match="No such file"):
        save_figure(drawn(), tmp_path / "no" / "a")
