"""Every command that writes a file: a full disk is one sentence, a signal ends it, and neither leaves anything."""

import functools
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from neurove_core.io.formats.hdf5.sink import Sink
from neurove_core.models import bundle, signing_keys


@pytest.fixture
def small_files():
    """No file of this process may become larger than 8,000 bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    signal.signal(signal.SIGXFSZ, before)


RECORDING = "sim://wall?seconds=0.2"


@pytest.mark.parametrize(
    "arguments",
    [
        ("convert", RECORDING, "a.h5"),
        ("convert", RECORDING, "a.mcap"),
        ("simulate", "wall", "--seconds", "0.2", "--out", "a.h5"),
        ("bundle", "new", "a.safetensors"),
        ("info", RECORDING, "--plot", "a.png"),
    ],
)
def test_a_full_disk_is_one_sentence_and_leaves_nothing(run, tmp_path, monkeypatch, small_files, arguments):
    pytest.importorskip("h5py")
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    code, _, err = run(*arguments)
    assert code in (1, 2)
    assert (err.count("\n"), err.startswith("neurove: ")) == (1, True)
    assert arguments[-1] in err
    assert "File too large" in err
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_keeps_the_file_that_was_there(run, tmp_path, small_files):
    file = tmp_path / "a.h5"
    file.write_bytes(b"before")
    assert run("convert", RECORDING, file, "--force")[0] == 1
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


TRAINING = """
name = "tiny"
[recipe]
steps = 8
"""


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("convert", RECORDING, "a.h5"), "a.h5"),
        (("simulate", "wall", "--seconds", "0.2", "--out", "a.h5"), "a.h5"),
        (("estimate", RECORDING, "--out", "a.csv"), "a.csv"),
        (("info", RECORDING, "--plot", "a.png"), "a.png"),
        (("demo", RECORDING, "--screenshot", "a.svg"), "a.svg"),
        (("bench", "streams", "--plot", "a"), "a.svg"),
        (("bundle", "new", "a.safetensors"), "a.safetensors"),
        (("bundle", "average", "one", "two", "--out", "a.safetensors"), "a.safetensors"),
        (("bundle", "sign", "one", "--key", "key"), "one.sig"),
        (("calibrate", "default", "--out", "a.safetensors"), "a.safetensors"),
        (("train", "tiny.toml", "--out", "."), "tiny.safetensors"),
        (("train", "tiny.toml", "--out", "."), "checkpoint.safetensors"),
    ],
)
def test_a_file_that_exists_is_replaced_only_by_force(run, tmp_path, monkeypatch, arguments, file):
    pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    Path("one").write_bytes(bundle.untrained(0).to_bytes())
    keys = signing_keys.new()
    Path("key").write_bytes(signing_keys.private_pem(keys))
    Path("tiny.toml").write_text(TRAINING)
    Path(file).write_bytes(b"before")
    code, out, err = run(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "--force replaces it" in err
    assert Path(file).read_bytes() == b"before"


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("bundle", "new", "a.safetensors"), "a.safetensors"),
        (("bundle", "sign", "one", "--key", "key"), "one.sig"),
        (("info", RECORDING, "--plot", "a.png"), "a.png"),
    ],
)
def test_force_replaces_the_file(run, tmp_path, monkeypatch, arguments, file):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    Path("one").write_bytes(bundle.untrained(0).to_bytes())
    Path("key").write_bytes(signing_keys.private_pem(signing_keys.new()))
    Path(file).write_bytes(b"before")
    assert run(*arguments, "--force")[0] == 0
    assert len(Path(file).read_bytes()) > 100


def test_half_a_pair_of_keys_is_not_left(run, tmp_path):
    (tmp_path / "neurove.pub").symlink_to(tmp_path / "none")
    code, out, err = run("bundle", "keygen", "--out", tmp_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert [file.name for file in tmp_path.iterdir()] == ["neurove.pub"]


def test_a_key_on_a_full_disk_is_not_left(run, tmp_path, small_files):
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    code, out, err = run("bundle", "keygen", "--out", tmp_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "name"), [(signal.SIGTERM, "a.h5"), (signal.SIGHUP, "a.mcap")])
def test_a_signal_ends_a_writer_as_control_c_does(tmp_path, number, name):
    command = [sys.executable, "-m", "neurove_service.cli", "simulate", "wall", "--seconds", "9999", "--out"]
    usual = functools.partial(signal.signal, number, signal.SIG_DFL)  # `nohup make test` ignores SIGHUP
    with subprocess.Popen(
        [*command, str(tmp_path / name)], stderr=subprocess.PIPE, text=True, preexec_fn=usual
    ) as child:
        while not any(part.stat().st_size > 200_000 for part in tmp_path.glob("*.part")):
            assert child.poll() is None
            time.sleep(0.01)
        child.send_signal(number)
        assert child.wait() == 128 + number
        assert child.stderr.read() == ""
    assert list(tmp_path.iterdir()) == []


def test_hdf5_reads_back_what_could_not_be_written(tmp_path, small_files):
    descriptor = os.open(tmp_path / "a", os.O_RDWR | os.O_CREAT)
    sink = Sink(descriptor)
    assert sink.write(b"a" * 7_000) == 7_000
    assert sink.error is None
    assert sink.write(b"b" * 2_000) == 2_000
    with pytest.raises(OSError, match="File too large"):
        sink.check()
    sink.truncate(9_000)
    assert sink.seek(0, os.SEEK_END) == 9_000
    sink.seek(6_998)
    assert sink.read(4) == b"aabb"
    assert sink.tell() == 7_002
    os.close(descriptor)
