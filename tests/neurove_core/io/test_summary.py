"""Summary of a recording, valid or broken: counts, rates, statistics, and a plot."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from neurove_core.geometry.motion import Poses, Twists, twists
from neurove_core.io import BrokenRecording, EventsOnly, Frame, Imu, Triggers
from neurove_core.io.recording import in_chunks
from neurove_core.io.summary import survey
from neurove_core.io.summary_plot import draw
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import InvalidField
from tests.builders import SENSOR, make_events
from tests.recordings import ecd_text, shared

RNG = np.random.default_rng(0)
GYRO, ACCEL = RNG.normal(3, 2, (2, 999, 3))


@dataclass
class Rich(EventsOnly):
    """A recording in memory that has all kinds of data. It can break at a chosen stream."""

    events: Events
    sensor: Sensor = SENSOR
    name: str = "rich"
    endless: bool = False
    chunk: int = 7  # number of events or inertial samples in a chunk
    breaks_in: str = ""

    @property
    def streams(self) -> tuple[str, ...]:
        return ("events", "imu", "frames", "triggers", "poses")

    def chunks(self) -> Iterator[Events]:
        for first in range(0, self.events.n, self.chunk):
            yield self.events.span(first, min(first + self.chunk, self.events.n))
        self._break("events")

    def imu(self) -> Iterator[Imu]:
        t = np.arange(999) * 1000
        for first in range(0, 999, self.chunk):
            part = slice(first, first + self.chunk)
            yield Imu(t[part], ACCEL[part], GYRO[part])
        self._break("imu")

    def frames(self) -> Iterator[Frame]:
        yield from (Frame(t, np.zeros((2, 2), np.uint8)) for t in range(5))

    def triggers(self) -> Iterator[Triggers]:
        yield Triggers(np.arange(3), np.zeros(3, np.uint8), np.ones(3, np.uint8))

    def poses(self) -> Poses:
        t = np.arange(0, 2_000_000, 10_000)
        return Poses(t, np.outer(t / 1e6, [3.0, 0, 4.0]), np.broadcast_to([0.0, 0, 0, 1], (t.size, 4)))

    def twists(self) -> Twists:
        self._break("twists")
        return twists(self.poses())

    def _break(self, where: str) -> None:
        if self.breaks_in == where:
            raise BrokenRecording(Path("rich"), f"the end of its {where}", "truncated")


def peak_by_hand(t: np.ndarray) -> float:
    return float(np.bincount((t - t[0]) // 10_000).max() * 100)


@pytest.mark.parametrize("chunk", [1, 7, 1000, 100_000])
def test_a_summary_does_not_depend_on_the_chunks_of_the_recording(chunk):
    events = make_events(n=3_000, seed=1)
    found = survey(Rich(events, chunk=chunk))
    summary = found.summary
    assert (summary.events, summary.first_us, summary.last_us) == (3_000, events.t[0], events.t[-1])
    assert summary.on_fraction == pytest.approx(events.p.mean())
    assert summary.duration_s == pytest.approx((events.t[-1] - events.t[0]) / 1e6)
    assert summary.mean_rate_hz == pytest.approx(3_000 / summary.duration_s)
    assert summary.peak_rate_hz == pytest.approx(peak_by_hand(events.t))
    assert (summary.frames, summary.triggers, summary.broken) == (5, 3, None)
    assert found.rate_t_us[0] == events.t[0]
    assert found.rate_t_us[-2] <= events.t[-1] < found.rate_t_us[-1]
    assert (found.rate_hz * np.diff(found.rate_t_us)).sum() / 1e6 == pytest.approx(3_000)


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_the_image_shows_fifty_milliseconds_of_the_second_half_of_the_recording(chunk):
    t = np.sort(np.random.default_rng(1).integers(0, 1_700_000, 3_000)) + 10**15
    events = Events.from_columns(t, t % 64, t % 48, t // 7 % 2)
    found = survey(Rich(events, chunk=chunk))
    start_us = found.counts_start_us
    assert 850_000 <= start_us - t[0] < 1_650_000
    part = events.span(*map(int, t.searchsorted([start_us, start_us + 50_000])))
    want = np.zeros((2, SENSOR.height, SENSOR.width), np.int64)
    np.add.at(want, (part.p, part.y, part.x), 1)
    np.testing.assert_array_equal(found.counts, want)
    short = survey(Rich(events.span(0, 20), chunk=chunk))
    assert (short.counts.sum(), short.counts_start_us) == (20, t[0])


def test_imu_and_ground_truth_are_in_si():
    summary = survey(Rich(make_events(n=100, seed=2))).summary
    assert summary.imu is not None
    assert (summary.imu.samples, summary.imu.rate_hz) == (999, pytest.approx(1000))
    np.testing.assert_allclose(summary.imu.gyro_mean_rad_s, GYRO.mean(axis=0))
    np.testing.assert_allclose(summary.imu.gyro_std_rad_s, GYRO.std(axis=0))
    np.testing.assert_allclose(summary.imu.accel_mean_m_s2, ACCEL.mean(axis=0))
    np.testing.assert_allclose(summary.imu.accel_std_m_s2, ACCEL.std(axis=0))
    assert summary.imu.accel_peak_m_s2 == pytest.approx(np.linalg.norm(ACCEL, axis=1).max())
    truth = summary.as_json()["truth"]
    assert (truth["from"], truth["samples"], truth["first_us"], truth["last_us"]) == ("poses", 200, 0, 1_990_000)
    assert truth["mean_linear_m_s"] == pytest.approx(5)
    assert truth["peak_linear_m_s"] == pytest.approx(5)
    assert truth["peak_angular_rad_s"] == pytest.approx(0, abs=1e-9)


def test_the_summary_as_json_has_the_keys_that_scripts_need():
    summary = survey(Rich(make_events(n=100, seed=3))).summary
    loaded = json.loads(json.dumps(summary.as_json()))
    assert loaded["sensor"] == {"width": SENSOR.width, "height": SENSOR.height}
    for key in ("events", "on_fraction", "first_us", "last_us", "duration_s", "streams", "imu", "truth"):
        assert key in loaded
    assert loaded["streams"] == ["events", "imu", "frames", "triggers", "poses"]


def test_values_of_a_recording_without_events_are_unknown(tmp_path: Path):
    summary = survey(Rich(Events.empty())).summary
    assert (summary.events, summary.duration_s) == (0, 0.0)
    for unknown in (summary.on_fraction, summary.first_us, summary.last_us, summary.mean_rate_hz, summary.peak_rate_hz):
        assert unknown is None
    one = survey(Rich(make_events(n=1, seed=0))).summary
    assert (one.events, one.duration_s, one.mean_rate_hz, one.peak_rate_hz) == (1, 0.0, None, 100)


def test_a_damaged_recording_is_summarised_with_its_faults(tmp_path: Path):
    events = make_events(n=1000, seed=4)
    file = tmp_path / "events.txt"
    file.write_bytes(ecd_text(events.span(0, 500)) + b"nonsense\n" + ecd_text(events.span(500, 1000)))
    summary = survey(open_source(str(file), SENSOR)).summary
    assert summary.events == 1000
    assert summary.broken is None
    (fault,) = summary.faults
    assert (fault.where, fault.count) == ("line 501", 1)
    assert summary.as_json()["faults"][0]["reason"] == "damaged"


@pytest.mark.parametrize("stream", ["events", "imu", "twists"])
def test_if_one_stream_breaks_the_others_are_still_summarised(stream):
    summary = survey(Rich(make_events(n=100, seed=5), breaks_in=stream)).summary
    assert (summary.events, summary.frames, summary.triggers) == (100, 5, 3)
    assert summary.imu is not None
    assert summary.imu.samples == 999
    assert (summary.truth is None) == (stream == "twists")
    assert summary.broken is not None
    assert f"the end of its {stream}" in summary.broken


def test_seconds_limits_the_summary_and_an_endless_source_needs_it():
    pattern = open_source("pattern://")
    summary = survey(pattern, seconds=0.5).summary
    assert summary.events > 1000
    assert 0.4 < summary.duration_s < 0.5
    for seconds in (None, 0.0, -1.0, float("nan")):
        with pytest.raises(InvalidField, match="seconds"):
            survey(pattern, seconds)


def test_the_rate_over_time_of_a_very_long_recording_has_a_bounded_number_of_bars():
    t = np.cumsum(RNG.integers(0, 10_000_000, 20_000))  # more than a day
    events = Events.from_columns(t, t % 64, t % 48, t % 2)
    found = survey(Rich(events, chunk=999))
    assert found.rate_hz.size <= 1024
    assert (found.rate_hz * np.diff(found.rate_t_us)).sum() / 1e6 == pytest.approx(20_000)
    assert found.summary.peak_rate_hz == peak_by_hand(t - t[0])


def test_a_pause_of_years_needs_no_memory():
    events = Events.from_columns([5, 6, 10**15], [1, 2, 3], [1, 2, 3], [0, 1, 1])
    assert survey(Rich(events)).summary.peak_rate_hz == 200


@pytest.mark.parametrize(
    ("path", "events", "on_fraction", "duration_s"),
    [
        ("aedat4/davis346.aedat4", 78_830, 0.523, 2.360),
        ("slider_depth/events_chunk.txt", 50_000, 0.423, 0.170),
        ("ecd/shapes_rotation_1.43s.txt", 120_000, None, 1.4287),
    ],
)
def test_the_summary_of_a_real_recording_has_its_known_values(path, events, on_fraction, duration_s):
    summary = survey(open_source(str(shared(path)))).summary
    assert summary.events == events
    assert on_fraction is None or summary.on_fraction == pytest.approx(on_fraction, abs=5e-4)
    assert summary.duration_s == pytest.approx(duration_s, abs=5e-4)


# --- the plot -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "magic"), [("a.png", b"\x89PNG"), ("b.svg", b"<?xml"), ("c.SVG", b"<?xml")])
def test_the_suffix_selects_the_format_of_the_plot_and_no_other_file_is_left(tmp_path: Path, name: str, magic: bytes):
    pytest.importorskip("matplotlib")
    draw(survey(Rich(make_events(n=500, seed=6))), tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(magic)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("n", [0, 1])
def test_a_recording_with_at_most_one_event_can_be_drawn(tmp_path: Path, n: int):
    pytest.importorskip("matplotlib")

    class Plain(Rich):
        def twists(self) -> None:  # type: ignore[override]  # as `Recording` allows
            return None

    for kind in (Rich, Plain):
        draw(survey(kind(make_events(n=n, seed=0))), tmp_path / "a.png")


def test_a_plot_that_cannot_be_written_is_refused(tmp_path: Path):
    pytest.importorskip("matplotlib")
    found = survey(Rich(make_events(n=50, seed=0)))
    for file in (tmp_path / "a.jpg", tmp_path / "a", tmp_path / "no" / "a.png"):
        with pytest.raises(InvalidField, match="plot"):
            draw(found, file)
    assert not list(tmp_path.iterdir())


def test_the_summary_does_not_change_the_events():
    events = make_events(n=100, seed=7)
    before = events.to_records()
    survey(Rich(Events.join(list(in_chunks(events)))))
    np.testing.assert_array_equal(events.to_records(), before)
