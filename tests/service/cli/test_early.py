"""Commands that wait for a service refuse wrong arguments at once, before they wait."""

import pytest

from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_core.models import bundle
from neurove_protocol.events import encode_packet
from neurove_service.cli import waiting
from tests.builders import make_packets

NOWHERE = ("--connect", "tcp/127.0.0.1:9", "--wait", "0.2")
NAME_RULE = "give 1 to 64 characters of A-Z a-z 0-9 _ . -"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A packet log, a bundle, a journal and files that are not what they are named."""
    with PacketWriter(tmp_path / "log.mcap") as log:
        for packet in make_packets(3, stream="left"):
            log.write("left", encode_packet(packet), packet.t0_us * 1000)
    bundle.save(bundle.untrained(1, name="one"), tmp_path / "one.safetensors")
    (tmp_path / "old.jsonl").write_text("{}")
    (tmp_path / "empty.yaml").write_text("a: 1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("drive pattern:// --stream a/b", NAME_RULE),
        ("drive dv://127.0.0.1:9 --stream a/b", NAME_RULE),
        ("drive log.mcap --loop", "drive: --loop=True: a replay would repeat sequence numbers"),
        ("record --out log.h5", "its name must end in .mcap"),
        ("record --out none/log.mcap", "none/log.mcap"),
        ("record --out new.mcap --stream a/b", "stream='a/b'"),
        ("health --node a/b", NAME_RULE),
        ("models --node a/b", NAME_RULE),
        ("drain --node a/b", NAME_RULE),
        ("push one.safetensors --node a/b", NAME_RULE),
        ("push none.safetensors", "none.safetensors"),
        ("push one.safetensors --force because", "give --activate too"),
        ("activate default --node a/b", NAME_RULE),
        ("activate default --canary cam0,a/b", NAME_RULE),
        ("activate default --shadow 3601", "give at most 3600 s"),
        (f"activate {'m' * 129}", "give a name or a digest of 1 to 128 characters"),
        ("rollback --node a/b", NAME_RULE),
        ("fleet list --update", "give that too"),
        ("rollout one.safetensors --journal old.jsonl", "--journal='old.jsonl': the file exists"),
        ("rollout one.safetensors --journal none/new.jsonl", "--journal='none/new.jsonl': its folder does not exist"),
        ("rollout one.safetensors --shadow 3601s", "give at most 1h"),
        ("ros2 --events /e --calibration none.yaml", "none.yaml"),
        ("ros2 --events /e --calibration empty.yaml", "it has no camera_matrix"),
        ("ros2 --events /e --via rclpy --ros-python ./python", "--ros-python='./python': no such program"),
    ],
)
def test_a_wrong_argument_is_refused_before_the_command_waits(folder, run, capsys, monkeypatch, command, why):
    waits = []
    monkeypatch.setattr(waiting.Wait, "__init__", lambda *_: waits.append(command))
    before = sorted(folder.iterdir())
    try:
        code, _, err = run(*command.split(), *NOWHERE)
    except SystemExit as ended:
        code, err = ended.code, capsys.readouterr().err
    assert why in err
    assert code in (1, 2)
    assert waits == []
    assert sorted(folder.iterdir()) == before


def test_a_recording_that_finds_no_service_leaves_no_file(folder, run):
    before = sorted(folder.iterdir())
    ran = run("record", "--out", "new.mcap", *NOWHERE)
    assert "no service" in ran.err
    assert ran.code == 1
    assert sorted(folder.iterdir()) == before
