"""AEDAT4: inertial samples, frames, triggers, and packets with bad events."""

import struct

import numpy as np
import pytest

from neurove_core.io import Frame, MissingGeometry, UnknownSource
from neurove_core.io.formats.aedat.aedat4 import EXPOSURE, EXTERNAL, GENERATOR, READOUT
from neurove_core.sources import open_source
from neurove_protocol import Events
from tests.builders import SENSOR, make_events
from tests.recordings import aedat4, all_samples, all_triggers, assert_same, put, read, read_broken, shared

EVENTS = make_events(300, seed=1, start_us=16_700_000)


@pytest.mark.parametrize(("name", "n", "rate_hz"), [("davis346", 2363, 1001), ("dvxplorer", 475, 805)])
def test_the_samples_of_a_stationary_camera_show_gravity_and_a_small_bias(name, n, rate_hz):
    imu = all_samples(open_source(str(shared(f"aedat4/{name}.aedat4"))))
    assert imu.t.size == n
    assert (np.diff(imu.t) >= 0).all()
    assert 1e6 * (n - 1) / (imu.t[-1] - imu.t[0]) == pytest.approx(rate_hz, abs=1)
    accel = imu.accel_m_s2.mean(0)
    assert np.linalg.norm(accel) == pytest.approx(9.81, rel=0.1)
    assert accel[1] == pytest.approx(-9.76, abs=0.01)
    assert np.abs(np.degrees(imu.gyro_rad_s.mean(0))).max() < 1
    if name == "davis346":
        assert accel[2] == pytest.approx(-2.55, abs=0.01)  # its images look down on a street
        np.testing.assert_allclose(np.degrees(imu.gyro_rad_s.mean(0)), (-0.739, -0.493, -0.114), atol=1e-3)


def test_each_frame_of_a_davis346_has_its_trigger_edges():
    recording = open_source(str(shared("aedat4/davis346.aedat4")))
    assert recording.streams == ("events", "imu", "frames", "triggers")
    frames = list(recording.frames())
    assert len(frames) == 59
    assert {(frame.image.shape, frame.image.dtype) for frame in frames} == {((260, 346), np.dtype(np.uint8))}
    assert (np.diff([frame.t_us for frame in frames]) > 0).all()
    triggers = all_triggers(recording)
    assert triggers.t.size == 236
    assert (np.diff(triggers.t) >= 0).all()
    for channel in (READOUT, EXPOSURE):
        for level in (0, 1):
            assert ((triggers.channel == channel) & (triggers.level == level)).sum() == 59
    began = triggers.t[(triggers.channel == EXPOSURE) & (triggers.level == 1)]
    assert np.isin([frame.t_us for frame in frames[1:]], began).all()


def test_a_camera_without_frames_has_none():
    recording = open_source(str(shared("aedat4/dvxplorer.aedat4")))
    assert recording.streams == ("events", "imu", "triggers")
    assert not list(recording.frames())
    assert not list(recording.triggers())


def trigger_packet(rows: list[tuple[int, int]]) -> bytes:
    """A packet of stream 1 with these times and sources, written as a flatbuffer: a vector of tables."""
    vector = 28 + 4 * len(rows)
    layout = -(-(vector - 4) // 8) * 8 + 4  # of all tables; times are 8-byte aligned if the size prefix is included
    tables = [layout + 8 + 24 * i for i in range(len(rows))]
    buffer = struct.pack("<I4sHHHxxiII", 16, b"TRIG", 6, 8, 4, 8, 4, len(rows))
    buffer += b"".join(struct.pack("<I", table - (28 + 4 * i)) for i, table in enumerate(tables))
    buffer += bytes(layout - vector) + struct.pack("<4H", 8, 24, 8, 16)
    for table, (t, source) in zip(tables, rows, strict=True):
        buffer += struct.pack("<ixxxxqb7x", table - layout, t, source)
    return struct.pack("<iiI", 1, len(buffer) + 4, len(buffer)) + buffer


def with_triggers(*packets: list[tuple[int, int]]) -> bytes:
    """A file with one packet of events and these packets of triggers."""
    file = aedat4([make_events(20, seed=1)], SENSOR, finished=False)
    return file.data[: file.stops[0]] + b"".join(map(trigger_packet, packets))


def test_the_input_and_the_generator_of_a_camera_have_separate_channels(tmp_path):
    rows = [(5, 1), (6, 2), (7, 0), (8, 3), (9, 4), (10, 5)]
    recording = open_source(put(tmp_path, "a.aedat4", with_triggers(rows, [(10, 2)])))
    assert recording.streams == ("events", "triggers")
    t, channel, level = (column.tolist() for column in all_triggers(recording))
    assert t == [5, 6, 8, 9, 10, 10]  # the reset of the clock at 7 is not an edge
    assert channel == [EXTERNAL] * 3 + [GENERATOR] * 2 + [EXTERNAL]
    assert level == [1, 0, 1, 1, 0, 0]
    assert not list(recording.imu())


def test_late_triggers_are_discarded_and_counted(tmp_path):
    recording = open_source(put(tmp_path, "a.aedat4", with_triggers([(5, 1)], [(4, 2)], [(6, 1)])))
    assert all_triggers(recording).t.tolist() == [5, 6]
    (fault,) = recording.faults.found
    assert (fault.stream, fault.reason, fault.count) == ("triggers", "late", 1)


@pytest.mark.parametrize("part", [0.3, 0.7])
def test_every_stream_of_a_truncated_file_gives_its_complete_packets_and_then_names_the_byte(part, tmp_path):
    data = shared("aedat4/davis346.aedat4").read_bytes()
    full = open_source(put(tmp_path, "a.aedat4", data))
    truncated = open_source(put(tmp_path, "b.aedat4", data[: int(part * len(data))]))
    for stream in ("imu", "frames", "triggers", "chunks"):
        got, want = list(getattr(truncated, stream)()), list(getattr(full, stream)())
        assert got
        if stream == "frames":
            got, want = [joined_frames(got)], [joined_frames(want)]
        for some, others in zip(zip(*got, strict=True), zip(*want, strict=True), strict=True):
            part_of, whole = np.concatenate(some), np.concatenate(others)
            assert part_of.size
            np.testing.assert_array_equal(part_of, whole[: len(part_of)])
    places = {fault.where for fault in truncated.faults.unread}
    assert len(truncated.faults.found) == 4
    assert len(places) == 1  # all streams end at the same place


def joined_frames(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([frame.t_us for frame in frames]), np.stack([frame.image for frame in frames])


# --- packets and streams of events -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("t", "x", "why"),
    [
        ((20, 30, 40), (1, 64, 3), "x=64 y=2 lies outside the sensor 64x48"),
        ((20, 30, 40), (1, 0xFFFF, 3), "x=-1 y=2 lies outside the sensor 64x48"),
        ((20, 19, 40), (1, 2, 3), "t=19 us comes after t=20 us"),
        ((9, 30, 40), (1, 2, 3), "t=9 us comes after t=10 us"),
    ],
)
def test_a_bad_event_is_skipped_and_named_by_its_packet(t, x, why, tmp_path):
    first, last = Events.from_columns([5, 10], [1, 2], [3, 4], [0, 1]), Events.from_columns([50], [1], [3], [0])
    second = Events.from_columns(t, x, [2, 2, 2], [1, 1, 1])
    file = aedat4([first, second, last], SENSOR)
    events, error = read_broken(open_source(put(tmp_path, "a.aedat4", file.data)))
    assert events.t.tolist() == sorted({5, 10, 50} | ({20, 30, 40} & set(t)) - ({30} if x[1] > 63 else set()))
    assert error is not None
    assert error.details["where"] == f"byte {file.starts[1]}"
    assert why in error.message


@pytest.mark.parametrize("shift", [1, 50, 8])
def test_after_a_damaged_packet_the_next_one_is_found(shift, tmp_path):
    packets = [make_events(50, seed=i, start_us=i * 200_000) for i in range(4)]
    file = aedat4(packets, SENSOR)
    data = bytearray(file.data)
    data[file.starts[1] : file.starts[1] + shift] = b"\xff" * shift  # the header of the second packet, or more
    recording = open_source(put(tmp_path, "a.aedat4", bytes(data)))
    assert_same(read(recording), Events.join([packets[0], packets[2], packets[3]]))
    (fault,) = recording.faults.found
    assert (fault.reason, fault.where) == ("damaged", f"byte {file.starts[1]}")


@pytest.mark.parametrize("name", ["davis346", "dvxplorer"])
def test_any_damaged_byte_of_a_packet_loses_at_most_that_packet_of_a_real_recording(name, tmp_path):
    data = shared(f"aedat4/{name}.aedat4").read_bytes()[:900_000]
    whole = read(open_source(put(tmp_path, "a.aedat4", data)))
    rng = np.random.default_rng(0)
    for at in rng.integers(20_000, 800_000, 6).tolist():
        damaged = bytearray(data)
        damaged[at] ^= 0xFF
        recording = open_source(put(tmp_path, "b.aedat4", bytes(damaged)))
        assert read(recording).n > whole.n - 3000


def test_a_chosen_event_stream_is_read_and_another_is_refused(tmp_path):
    path = put(tmp_path, "a.aedat4", aedat4([EVENTS], SENSOR).data)
    assert_same(read(open_source(path, topic="0")), EVENTS)
    with pytest.raises(UnknownSource, match="no event stream '1'; its event streams are 0"):
        open_source(path, topic="1")


def test_a_packet_without_events_gives_no_chunk(tmp_path):
    file = aedat4([Events.empty(), EVENTS, Events.empty()], SENSOR)
    assert_same(read(open_source(put(tmp_path, "a.aedat4", file.data))), EVENTS)


def test_an_aedat4_file_without_an_event_stream_or_a_size_is_refused(tmp_path):
    data = aedat4([EVENTS], SENSOR).data
    with pytest.raises(UnknownSource, match="no event stream"):
        open_source(put(tmp_path, "a.aedat4", data.replace(b">EVTS<", b">FRME<")))
    without_size = put(tmp_path, "a.aedat4", data.replace(b">64<", b">00<"))
    with pytest.raises(MissingGeometry):
        open_source(without_size)
    assert_same(read(open_source(without_size, SENSOR)), EVENTS)
    with pytest.raises(UnknownSource, match="does not begin with the AEDAT4 signature"):
        open_source(put(tmp_path, "a.aedat4", b"#!AER-DAT5.0\r\n"))


def test_the_first_of_several_event_streams_is_read_and_named(tmp_path):
    data = aedat4([EVENTS], SENSOR).data
    size = b'<attr key="sizeX" type="int">64</attr><attr key="sizeY" type="int">48</attr>'
    both = data.replace(b">TRIG<", b">EVTS<").replace(b'1/info/"></node>', b'1/info/">' + size + b"</node>")
    longer = len(both) - len(data)
    header = bytearray(both)
    for at, form in ((14, "<u4"), (46, "<i8"), (58, "<u4")):  # lengths of header and text, and the end of the packets
        header[at : at + int(form[2])] = (np.frombuffer(both, form, 1, at) + longer).astype(form).tobytes()
    recording = open_source(put(tmp_path, "a.aedat4", bytes(header)))
    assert recording.name == "a.aedat4 (stream 0, the first of 2 event streams)"
