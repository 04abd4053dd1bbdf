"""NeuroVE recordings: packets bit for bit, and conversion of other recordings."""

import numpy as np
import pytest

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io import BrokenRecording, UnknownSource
from neurove_core.io.formats.packet_log.reader import McapRecording
from neurove_core.io.formats.packet_log.writer import PacketWriter, write_mcap
from neurove_core.io.packets import slices
from neurove_core.io.recording import EventsOnly, Frame, Triggers
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events, NeuroVEError, Sensor
from neurove_protocol.events import decode_packet, encode_packet
from neurove_protocol.imu import Imu
from tests.builders import SENSOR, make_events, make_packet, make_packets
from tests.recordings import assert_same, read, read_broken, shared

CAMERA = CameraInfo(stream="cam0", width=64, height=48, lens="equidistant", fx=50.0, fy=51.0, cx=31.0, cy=23.0)


def write(path, payloads, camera=None):
    with PacketWriter(path) as writer:
        if camera:
            writer.camera(camera.encode())
        for i, (stream, payload) in enumerate(payloads):
            writer.write(stream, payload, 10**18 + i)
    return path


class Rich(EventsOnly):
    """A recording that holds every kind of data."""

    name, sensor, endless = "rich", SENSOR, False

    def __init__(self, events):
        self.events = events
        t = np.arange(9000) * 100
        self.parts = {
            "imu": Imu(t, t[:, None] * (1.0, 2.0, 3.0), t[:, None] * (0.1, 0.2, 0.3)),
            "triggers": Triggers(t[:3], np.array([6, 6, 1], np.uint8), np.array([0, 1, 0], np.uint8)),
            "poses": Poses(t, t[:, None] * (1.0, 0.0, -1.0), np.tile((0.0, 0.6, 0.0, 0.8), (9000, 1))),
            "twists": Twists(t, np.where(t[:, None] < 200, np.nan, t[:, None] * np.arange(6.0))),
        }
        rng = np.random.default_rng(0)
        self.images = [Frame(40 * i, rng.integers(0, 256, (48, 64, 3)[: 2 + i % 2], np.uint8)) for i in range(4)]

    def chunks(self):
        yield self.events

    def camera(self, stream):
        return CameraInfo(**(CAMERA.model_dump() | {"stream": stream}))

    def imu(self):
        yield self.parts["imu"]

    def triggers(self):
        yield self.parts["triggers"]

    def poses(self):
        return self.parts["poses"]

    def twists(self):
        return self.parts["twists"]

    def frames(self):
        yield from self.images


def test_packets_are_read_back_bit_for_bit_including_invalid_ones(tmp_path):
    payloads = [("b", encode_packet(packet)) for packet in make_packets(40, n=500)]
    payloads[3:3] = [("a", b"no packet at all"), ("a", b""), ("b", payloads[0][1])]
    path = write(tmp_path / "a.mcap", payloads, CAMERA)
    recording = McapRecording.open(path, SENSOR, "b")
    assert [(stream, payload) for stream, payload, _ in recording.packets()] == payloads
    assert [payload for _, payload, _ in recording.packets("a")] == [b"no packet at all", b""]
    assert [log_ns for *_, log_ns in recording.packets()] == [10**18 + i for i in range(len(payloads))]
    assert recording.cameras() == {}  # the camera's stream has no packets


def test_a_converted_recording_equals_its_source(tmp_path):
    rich = Rich(make_events(30_000, duration_us=900_000))
    path = tmp_path / "a.mcap"
    assert write_mcap(rich, path, "left") == 30_000
    recording = open_source(str(path))
    assert_same(read(recording), rich.events)
    assert (recording.sensor, recording.name) == (SENSOR, "a.mcap")
    assert recording.streams == ("events", "imu", "frames", "triggers", "poses", "twists")
    assert recording.camera("cam7") == rich.camera("cam7")
    for kind in ("imu", "triggers"):
        got = list(getattr(recording, kind)())
        for column, want in zip(zip(*got, strict=True), rich.parts[kind], strict=True):
            np.testing.assert_array_equal(np.concatenate(column), want)
    for kind in ("poses", "twists"):
        for column, want in zip(getattr(recording, kind)(), rich.parts[kind], strict=True):
            np.testing.assert_array_equal(column, want)
    for frame, image in zip(recording.frames(), rich.images, strict=True):
        assert frame.t_us == image.t_us
        np.testing.assert_array_equal(frame.image, image.image)
    assert McapRecording.open(path).file.metadata["neurove"] == {"source": "rich", "stream": "left", "events": "30000"}


def test_packets_are_split_as_the_driver_splits_them(tmp_path):
    rich = Rich(make_events(5000, duration_us=100_000))
    write_mcap(rich, tmp_path / "a.mcap")
    packets = [decode_packet(payload) for _, payload, _ in McapRecording.open(tmp_path / "a.mcap").packets()]
    want = list(slices(rich.chunks()))
    assert [packet.seq for packet in packets] == list(range(len(want)))
    assert [(packet.t0_us, packet.events.n) for packet in packets] == [(one.t0_us, one.events.n) for one in want]


def test_since_gives_exactly_the_later_events(tmp_path):
    events = make_events(600_000, duration_us=4_000_000)
    write_mcap(Rich(events), tmp_path / "a.mcap")
    recording = McapRecording.open(tmp_path / "a.mcap")
    assert len(recording.file.chunks) > 3
    for t_us in (-1, 0, 1_234_567, 3_999_000, 4_000_001):
        later = Events.join(list(recording.since(t_us)))
        assert_same(later, events.span(int(np.searchsorted(events.t, t_us)), events.n))


@pytest.mark.parametrize("path", ["rosbag/test_events_2", "ecd/shapes_rotation", "aedat4/dvxplorer.aedat4"])
def test_a_converted_real_recording_equals_its_source(tmp_path, path):
    source = open_source(str(shared(path)))
    write_mcap(source, tmp_path / "a.mcap")
    recording = open_source(str(tmp_path / "a.mcap"))
    assert_same(read(recording), read(source))
    assert recording.camera("cam0") == source.camera("cam0")


def test_one_of_several_streams_is_selected_by_name(tmp_path):
    payloads = [(name, encode_packet(make_packet(seed=i, stream=name))) for i, name in enumerate(("right", "left"))]
    path = str(write(tmp_path / "a.mcap", payloads))
    assert open_source(path).name == "a.mcap (left, the first of 2 streams)"
    assert_same(read(open_source(path, topic="right")), make_packet(seed=0).events)
    assert_same(read(open_source(path, topic="right/events")), make_packet(seed=0).events)
    with pytest.raises(UnknownSource, match="no stream 'up'; its streams are left, right"):
        open_source(path, topic="up")


def test_a_recording_truncated_before_its_first_packet_has_no_stream(tmp_path):
    packets = [("cam0", encode_packet(make_packet()))]
    (tmp_path / "truncated.mcap").write_bytes(write(tmp_path / "a.mcap", packets).read_bytes()[:200])
    with pytest.raises(UnknownSource, match="the file has no stream of events"):
        open_source(str(tmp_path / "truncated.mcap"))


def test_the_file_gets_its_name_only_when_the_recording_is_complete(tmp_path):
    path = tmp_path / "a.mcap"
    with PacketWriter(path) as writer:
        writer.write("cam0", b"1", 0)
        assert not path.exists()
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]
    before = path.read_bytes()

    class Broken(Rich):
        def chunks(self):
            yield self.events
            raise BrokenRecording(path, "byte 7", "truncated")

    with pytest.raises(BrokenRecording, match="byte 7"):
        write_mcap(Broken(make_events(100)), path)
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]
    assert path.read_bytes() == before


def test_the_partial_file_of_a_killed_recorder_can_be_read_after_a_rename(tmp_path):
    packets = make_packets(300, n=4000)
    writer = PacketWriter(tmp_path / "a.mcap")
    for packet in packets:
        writer.write("cam0", encode_packet(packet), 0)
    (tmp_path / "renamed.mcap").write_bytes((tmp_path / "a.mcap.part").read_bytes())
    writer.abandon()
    events, error = read_broken(open_source(str(tmp_path / "renamed.mcap")))
    assert error is not None
    assert 600_000 < events.n < 1_200_000
    assert_same(events, Events.join([packet.events for packet in packets]).span(0, events.n))


def test_an_incomplete_recording_is_not_overwritten(tmp_path):
    (tmp_path / "a.mcap.part").write_bytes(b"a partial file")
    with pytest.raises(NeuroVEError, match=r"a\.mcap\.part.*an incomplete recording"):
        PacketWriter(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap.part").read_bytes() == b"a partial file"


@pytest.mark.parametrize(("name", "why"), [("a.h5", "must end in .mcap"), ("nowhere/a.mcap", "No such file")])
def test_a_file_that_cannot_be_written_is_reported(tmp_path, name, why):
    with pytest.raises(NeuroVEError, match=why):
        PacketWriter(tmp_path / name)


def test_an_endless_source_is_rejected(tmp_path):
    with pytest.raises(NeuroVEError, match="it has no end"):
        write_mcap(open_source("pattern://"), tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_file_gives_its_complete_packets_and_then_an_error(tmp_path):
    events = make_events(3000, duration_us=100_000)
    write_mcap(Rich(events), tmp_path / "a.mcap")
    data, counts = (tmp_path / "a.mcap").read_bytes(), set()
    for size in range(0, len(data), 4001):
        truncated = tmp_path / "truncated.mcap"
        truncated.write_bytes(data[:size])
        try:
            got, error = read_broken(open_source(str(truncated)))
        except (UnknownSource, BrokenRecording):
            continue
        assert_same(got, events.span(0, got.n))
        assert error is not None or got.n == events.n
        counts.add(got.n)
    assert 3000 in counts


@pytest.mark.parametrize(
    ("payloads", "why"),
    [
        ([b"\x81\xa1v\x01"], "missing"),
        ([b"no packet"], "not a valid message"),
        ([encode_packet(make_packet(t0_us=0, seq=1))], "time"),
        (
            [encode_packet(make_packet(t0_us=9000, sensor=Sensor(80, 60)))],
            "a packet has sensor 80x60, but the first packet has 64x48",
        ),
    ],
)
def test_an_invalid_packet_is_skipped_and_counted_with_its_place(tmp_path, payloads, why):
    good, after = make_packet(t0_us=5000), make_packet(t0_us=900_000, seq=2)
    path = write(tmp_path / "a.mcap", [("cam0", one) for one in (encode_packet(good), *payloads, encode_packet(after))])
    recording = McapRecording.open(path)
    got, error = read_broken(recording)
    assert_same(got, Events.join([good.events, after.events]))
    assert error is not None
    assert why in error.message
    assert "byte" in error.message
    assert len(list(recording.packets())) == 3
