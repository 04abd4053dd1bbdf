import json
import signal
import threading

import pytest

from neurove_core.io.formats.packet_log.reader import McapRecording
from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo
from neurove_protocol.events import decode_packet, encode_packet
from neurove_protocol.imu import decode_imu
from neurove_protocol.keys import Keys
from neurove_service.clients.recorder import Recorder
from tests.builders import make_packets
from tests.live.conftest import client, free_endpoint, running, wait_until

pytestmark = pytest.mark.live

CAMERA = CameraInfo(stream="left", width=64, height=48, lens="pinhole", fx=50.0, fy=50.0, cx=31.5, cy=23.5)


class Listener:
    """Every published packet and CameraInfo."""

    def __init__(self, transport):
        self.payloads, self.cameras = [], {}
        transport.subscribe(
            Keys().events(), lambda key, payload, _: self.payloads.append((Keys().stream_of(key), payload))
        )
        transport.subscribe(
            Keys().camera(), lambda key, payload, _: self.cameras.update({Keys().stream_of(key): payload})
        )


def test_driven_packets_are_recorded_and_replayed_bit_for_bit(router, tmp_path, run):
    file = tmp_path / "traffic.mcap"
    with client(router) as transport:
        heard = Listener(transport)
        with running("record", "--connect", router, "--out", str(file), "--json") as recorder:
            wait_until(lambda: file.with_name("traffic.mcap.part").exists())
            driven = run(
                "drive", "pattern://?seed=4", "--connect", router, "--seconds", "0.6", "--wait", "90", "--json"
            )
            sent = json.loads(driven.out)
            assert sent["packets"] == 150
            wait_until(lambda: len(heard.payloads) == 150)
            code, out, err = recorder.end(signal.SIGINT)
        assert (code, err) == (0, "")
        summary = json.loads(out)["streams"]["cam0"]
        assert (summary["packets"], summary["events"], summary["missing"], summary["dropped"]) == (
            150,
            sent["events"],
            0,
            0,
        )

        recording = open_source(str(file))
        assert isinstance(recording, McapRecording)
        assert [(stream, payload) for stream, payload, _ in recording.packets()] == heard.payloads
        assert recording.cameras() == heard.cameras
        assert sum(chunk.n for chunk in recording.chunks()) == sent["events"]

        before, heard.payloads = heard.payloads, []
        replayed = run("drive", str(file), "--connect", router, "--wait", "90")
        assert replayed.out.startswith("cam0: 150 packets")
        wait_until(lambda: len(heard.payloads) == 150)
        assert heard.payloads == before


def two_streams(path):
    packets = [("left", encode_packet(one)) for one in make_packets(25, stream="left", n=50)]
    packets += [("right", encode_packet(one)) for one in make_packets(25, stream="right", n=60, start_us=10**9)]
    packets.insert(30, ("left", b"no packet"))
    with PacketWriter(path) as writer:
        writer.camera(CAMERA.encode())
        for i, (stream, payload) in enumerate(packets):
            writer.write(stream, payload, 10**18 + i * 10**5)
    return packets


def test_a_replay_keeps_all_streams_or_the_selected_one_and_encodes_again_under_another_name(router, tmp_path, run):
    packets = two_streams(tmp_path / "two.mcap")
    file = str(tmp_path / "two.mcap")
    with client(router) as transport:
        heard = Listener(transport)
        assert run("drive", file, "--connect", router, "--wait", "90").code == 0
        wait_until(lambda: len(heard.payloads) == 51)
        assert [one for one in heard.payloads if one[0] == "left"] == [one for one in packets if one[0] == "left"]
        assert [one for one in heard.payloads if one[0] == "right"] == [one for one in packets if one[0] == "right"]
        assert heard.cameras == {"left": CAMERA.encode()}

        heard.payloads = []
        run("drive", file, "--topic", "right", "--connect", router, "--wait", "90")
        wait_until(lambda: len(heard.payloads) == 25)
        assert heard.payloads == [one for one in packets if one[0] == "right"]

        heard.payloads = []
        run("drive", file, "--topic", "right", "--stream", "front", "--connect", router, "--wait", "90")
        wait_until(lambda: len(heard.payloads) > 24)
        assert {stream for stream, _ in heard.payloads} == {"front"}
        assert sum(decode_packet(payload).events.n for _, payload in heard.payloads) == 25 * 60


def test_a_replay_that_cannot_be_repeated_is_refused_without_a_service(tmp_path, run):
    two_streams(tmp_path / "two.mcap")
    nowhere = ("--connect", free_endpoint(), "--wait", "0.1")
    looped = run("drive", tmp_path / "two.mcap", "--loop", *nowhere)
    assert looped.code == 2
    assert "give --stream NAME" in looped.err
    ambiguous = run("drive", tmp_path / "two.mcap", "--height", "1", *nowhere)
    assert ambiguous.code == 2
    assert "choose one with --topic" in ambiguous.err


def test_a_recorder_counts_missing_packets_and_keeps_unreadable_ones(router, tmp_path):
    file = tmp_path / "gaps.mcap"
    with client(router) as transport:
        transport.answer(Keys().camera("left"), lambda _: CAMERA.encode())
        publisher = transport.publisher(Keys().events("left"), "application/msgpack")
        other = transport.publisher(Keys().events("right"), "application/msgpack")
        record = ("record", "--connect", router, "--out", str(file), "--stream", "left", "--seconds", "3")
        with running(*record, "--json") as recorder:
            wait_until(lambda: publisher.matching)
            for packet in make_packets(10, stream="left"):
                if packet.seq not in (3, 4, 7):
                    publisher.put(encode_packet(packet))
            publisher.put(b"no packet")
            assert not other.matching
            out, _ = recorder.child.communicate(timeout=60)
        streams = json.loads(out)["streams"]
    assert recorder.child.returncode == 1
    assert {name: streams["left"][name] for name in ("packets", "missing", "refused", "dropped")} == {
        "packets": 8, "missing": 3, "refused": 1, "dropped": 0,
    }  # fmt: skip
    assert list(streams) == ["left"]
    assert McapRecording.open(file).cameras() == {"left": CAMERA.encode()}


def test_the_summary_has_recorded_and_missing_packets(router, tmp_path, run):
    with client(router) as transport:
        publisher = transport.publisher(Keys().events("left"), "application/msgpack")

        def drive():
            wait_until(lambda: publisher.matching)
            for packet in make_packets(5, stream="left", n=100):
                if packet.seq != 2:
                    publisher.put(encode_packet(packet))

        driver = threading.Thread(target=drive)
        driver.start()
        code, out, err = run("record", "--connect", router, "--out", tmp_path / "a.mcap", "--seconds", "1")
        driver.join()
    assert (code, out) == (1, "left: 4 packets, 400 events, 1 missing\n")
    assert err.startswith(f"wrote {tmp_path / 'a.mcap'}, ")


def test_a_truncated_recording_is_replayed_up_to_its_end_and_exits_with_1(router, tmp_path, run):
    payloads = [encode_packet(packet) for packet in make_packets(300, n=4000)]
    with PacketWriter(tmp_path / "whole.mcap") as writer:
        for payload in payloads:
            writer.write("cam0", payload, 10**18)
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "truncated.mcap").write_bytes(data[: len(data) // 2])
    with client(router) as transport:
        heard = Listener(transport)
        code, out, err = run("drive", tmp_path / "truncated.mcap", "--connect", router, "--wait", "90")
        wait_until(lambda: out.startswith(f"cam0: {len(heard.payloads)} packets"))
    assert code == 1
    assert "truncated.mcap: broken at byte" in err
    assert 0 < len(heard.payloads) < 300
    assert [payload for _, payload in heard.payloads] == payloads[: len(heard.payloads)]


def test_a_replay_without_a_service_is_an_error(router, tmp_path, run):
    two_streams(tmp_path / "two.mcap")
    code, out, err = run("drive", tmp_path / "two.mcap", "--connect", router, "--wait", "0.2")
    assert (code, out) == (1, "")
    assert "no service subscribed to stream left, right within 0.2 s" in err


def test_packets_beyond_the_size_of_the_queue_are_dropped_and_counted(router, tmp_path):
    packets = make_packets(20, stream="left", n=100)
    payloads = [encode_packet(packet) for packet in packets]
    cap = sum(map(len, payloads[:5]))
    with client(router) as transport, client(router) as other, PacketWriter(tmp_path / "a.mcap") as writer:
        recorder = Recorder(writer, transport, Keys(), queue_bytes=cap)
        heard = Listener(transport)
        publisher = other.publisher(Keys().events("left"), "application/msgpack")
        wait_until(lambda: publisher.matching)
        for payload in payloads:
            publisher.put(payload)
        wait_until(lambda: len(heard.payloads) == 20)  # all arrive before the first one is written
        stop = threading.Event()
        stop.set()
        account = recorder.run(stop, 1.0)["left"]
    assert (account.packets, account.dropped, account.events) == (5, 15, 500)
    assert [payload for _, payload, _ in McapRecording.open(tmp_path / "a.mcap").packets()] == payloads[:5]


def test_an_existing_recording_is_not_overwritten_and_without_packets_there_is_no_file(router, tmp_path, run):
    (tmp_path / "old.mcap").write_bytes(b"dear")
    refused = run("record", "--connect", router, "--out", str(tmp_path / "old.mcap"))
    assert (refused.code, "never overwritten" in refused.err) == (2, True)
    silent = run("record", "--connect", router, "--out", str(tmp_path / "new.mcap"), "--seconds", "0.3")
    assert (silent.code, silent.err.count("\n")) == (1, 1)
    assert "nothing was recorded" in silent.err
    assert [one.name for one in tmp_path.iterdir()] == ["old.mcap"]


def test_inertial_samples_are_driven_recorded_and_replayed_bit_for_bit(router, tmp_path, run):
    file = tmp_path / "inertial.mcap"
    source = "sim://wall?seed=20005&camera=pinhole:24x18:75&seconds=0.4&imu=500"
    with client(router) as transport:
        heard = []
        transport.subscribe(Keys().events(), lambda *_: None)  # a driver waits for it
        transport.subscribe(Keys().imu(), lambda _, payload, __: heard.append(payload))
        with running("record", "--connect", router, "--out", str(file), "--json") as recorder:
            wait_until(lambda: file.with_name("inertial.mcap.part").exists())
            sent = json.loads(run("drive", source, "--connect", router, "--wait", "90", "--json").out)
            assert sent["samples"] == 200
            wait_until(lambda: sum(decode_imu(payload).samples.n for payload in heard) == 200)
            code, out, _ = recorder.end(signal.SIGINT)
        summary = json.loads(out)["streams"]["cam0"]
        assert (code, summary["samples"], summary["missing"]) == (0, 200, 0)
        assert [decode_imu(payload).seq for payload in heard] == list(range(len(heard)))
        recording = open_source(str(file))
        assert "imu" in recording.streams
        assert sum(batch.n for batch in recording.imu()) == 200
        before, heard[:] = heard.copy(), []
        assert "200 IMU samples" in run("drive", str(file), "--connect", router, "--wait", "90").out
        wait_until(lambda: len(heard) == len(before))
        assert heard == before
