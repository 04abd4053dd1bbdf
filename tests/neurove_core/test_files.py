"""Atomic writes: a file has its new content or its old one."""

import errno
import os
import tempfile
from pathlib import Path

import pytest

from neurove_core.figures import blank_figure, save_figure
from neurove_core.files import (
    allow_no_temporary_folder,
    atomic_path,
    move_folder,
    stamp,
    why_unreadable,
    write_atomically,
)
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


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError("Can't write data (file write failed: errno = 28, error message = 'No space left on device')"),
        RuntimeError("Can't decrement id ref count (file write failed: filename = 'x', errno = 28, buf = 0x1)"),
    ],
)
def test_an_error_of_any_writing_library_names_the_file_and_the_reason(tmp_path, error):
    file = tmp_path / "a.h5"
    with pytest.raises(OSError, match="No space left on device") as raised, atomic_path(file):
        raise error
    assert (raised.value.errno, raised.value.filename) == (errno.ENOSPC, str(file))


@pytest.mark.parametrize(
    "error", [RuntimeError("a bug"), OSError("no number"), FileNotFoundError(errno.ENOENT, "No such file", "input")]
)
def test_an_error_of_something_else_passes_unchanged(tmp_path, error):
    with pytest.raises(type(error)) as raised, atomic_path(tmp_path / "a.h5"):
        raise error
    assert raised.value is error


def test_a_stamp_tells_a_replaced_file_of_equal_size_and_time(tmp_path):
    file, other = tmp_path / "a", tmp_path / "b"
    file.write_bytes(b"one")
    first = stamp(file)
    other.write_bytes(b"two")
    os.utime(other, ns=(first.content_ns, first.content_ns))
    other.replace(file)
    second = stamp(file)
    assert (first.size, first.content_ns) == (second.size, second.content_ns)
    assert first != second
    file.write_bytes(b"six")
    os.utime(file, ns=(first.content_ns, first.content_ns))
    assert stamp(file) not in (first, second)
    assert stamp(tmp_path / "none") is None


def test_a_folder_that_cannot_be_listed_has_a_reason(tmp_path):
    assert why_unreadable(tmp_path) is None
    assert why_unreadable(tmp_path / "none") == "No such file or directory"
    (tmp_path / "a").touch()
    assert why_unreadable(tmp_path / "a") == "Not a directory"


def test_without_a_temporary_folder_torch_gets_one_that_exists(monkeypatch):
    def none():
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    allow_no_temporary_folder()
    assert "TORCHINDUCTOR_CACHE_DIR" not in os.environ
    monkeypatch.setattr(tempfile, "gettempdir", none)
    allow_no_temporary_folder()
    assert Path(os.environ["TORCHINDUCTOR_CACHE_DIR"]).is_dir()


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
