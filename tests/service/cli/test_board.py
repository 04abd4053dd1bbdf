"""The live table: what is shown, in which order, and what is grey because it is old."""

import html
import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from neurove_protocol import Flag
from neurove_protocol.velocity import AXES
from neurove_service.cli import lines
from neurove_service.cli.board import OLD, Board
from neurove_service.node.health import stream_status
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import arrived


class Clock:
    """A monotonic clock that a test sets [s]."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def drawn(renderable, width=140, color=None):
    console = Console(file=io.StringIO(), width=width, color_system=color, force_terminal=color is not None)
    console.print(renderable)
    return console.file.getvalue()


@pytest.fixture
def stream(slot):
    return Stream("cam0", slot)


@pytest.fixture
def estimates(stream):
    return [one for packet in make_packets(60) for one in stream.accept(packet, arrived())]


def live_board(estimates, clock=None, **options):
    """A board on which the estimates arrived every 50 ms."""
    clock = clock or Clock()
    board = Board(clock=clock, **options)
    for estimate in estimates:
        clock.now += 0.05
        board.on_estimate(estimate)
    return board


def named(estimate, name, **changes):
    return estimate.model_copy(update={"stream": name, **changes})


def test_a_board_shows_the_newest_velocity_its_flags_and_every_loss(stream):
    board = Board()
    assert "waiting" in drawn(board)
    packets = make_packets(60)
    for packet in packets[:30] + packets[33:]:
        for estimate in stream.accept(packet, arrived()):
            board.on_estimate(estimate)
    board.on_status(stream_status("n1", stream))
    text = drawn(board)
    newest = board.of("cam0").last.twist
    assert f"{newest.vx:+7.3f} m/s" in text
    assert f"{newest.wz:+7.3f} rad/s" in text
    for word in ("cam0", "lossy", "64x48", "gap_packets 3", "uncalibrated"):
        assert word in text


def test_a_board_warns_of_an_untrained_model(estimates):
    assert "UNTRAINED" not in drawn(live_board(estimates))
    untrained = live_board([named(estimates[0], "cam0", flags=("untrained",))])
    assert "UNTRAINED: the estimates have no meaning" in drawn(untrained)


def test_a_board_shows_the_standard_deviation_of_each_axis(estimates):
    board = Board()
    for estimate in estimates:
        covariance = [0.0] * 36
        covariance[0], covariance[35] = 0.0625, 4e8
        board.on_estimate(estimate.model_copy(update={"covariance": tuple(covariance)}))
    assert "±0.250 m/s" in drawn(board)
    assert "±20000 rad/s" in drawn(board)


def test_a_board_counts_missed_estimates(estimates):
    board = Board()
    for estimate in (estimates[0], estimates[3]):
        board.on_estimate(estimate)
    assert (board.of("cam0").count, board.of("cam0").missed) == (2, 2)
    assert board.of("cam0").mean_rate_hz > 0


def test_what_is_older_than_two_windows_is_grey_and_says_since_when(estimates):
    clock = Clock()
    board = live_board(estimates, clock)
    clock.now += 0.09
    live = drawn(board, color="standard")
    assert "no estimate since" not in live
    assert "estimates/s" in live
    clock.now += 8.0
    old = drawn(board, color="standard")
    assert "no estimate since" in old
    assert "8.1 s ago" in old
    assert "estimates/s" not in old
    assert "\x1b[90m" in old
    assert "\x1b[90m" not in live
    assert "\x1b[32m" not in old  # no green
    assert OLD == "bright_black"


def test_a_source_that_is_played_slowly_is_not_old(estimates):
    clock = Clock()
    board = Board(clock=clock)
    for estimate in estimates:
        clock.now += 0.5  # a tenth of real time
        board.on_estimate(estimate)
    clock.now += 0.9
    assert board.of("cam0").is_live(clock.now)
    clock.now += 0.2
    assert not board.of("cam0").is_live(clock.now)


def test_live_streams_come_first_then_the_names(estimates):
    clock = Clock()
    board = live_board([named(estimates[0], "a"), named(estimates[1], "a")], clock)
    clock.now += 5
    for estimate in estimates[:3]:
        clock.now += 0.05
        board.on_estimate(named(estimate, "c"))
        board.on_estimate(named(estimate, "b"))
    assert list(board.streams()) == ["b", "c", "a"]


def test_a_terminal_of_60_columns_shows_one_line_per_stream(estimates):
    clock = Clock()
    board = live_board([named(one, "a_camera_with_a_long_name") for one in estimates], clock)
    for estimate in estimates:
        board.on_estimate(named(estimate, "b"))
    text = drawn(board, width=60)
    rows = text.splitlines()
    assert all(len(row) <= 60 for row in rows)
    assert [row.split()[0] for row in rows[:3]] == ["stream", "a_c…ame", "b"]
    newest = estimates[-1].twist
    assert [float(word) for word in rows[2].split()[1:7]] == pytest.approx(list(newest), abs=6e-3)
    clock.now += 75
    assert drawn(board, width=60).splitlines()[1].endswith("75 s ago")


@pytest.mark.parametrize("value", [0.0, 0.0014, -9.9996, 123.456, -12345.6, 1e9, -1e-12])
def test_a_number_of_a_line_fits_its_columns(estimates, value):
    twist = (value,) * len(AXES)
    board = live_board([named(estimates[0], "b", twists=(type(estimates[0].twist)(*twist),) * 5)])
    row = drawn(board, width=60).splitlines()[1]
    assert len(row.rstrip()) <= 60
    assert [float(word) for word in row.split()[1:7]] == pytest.approx(list(twist), rel=0.06, abs=6e-4)


def test_the_legend_names_the_frame_the_units_and_sigma(estimates):
    text = " ".join(drawn(live_board(estimates), width=60).split())
    for words in (
        "camera_optical",
        "x right, y down, z forward",
        "m/s",
        "rad/s",
        "one standard deviation",
        "two windows",
    ):
        assert words in text


def test_a_stream_without_lens_or_height_says_in_one_line_what_to_do(estimates):
    assert Flag.UNCALIBRATED in estimates[-1].flags
    (note,) = [row for row in drawn(live_board(estimates)).splitlines() if "--calibration" in row]
    assert note.startswith("cam0: no lens: ")
    unscaled = live_board([named(estimates[-1], "cam0", flags=("unscaled",))])
    (note,) = [row for row in drawn(unscaled).splitlines() if "--height" in row]
    assert note.startswith("cam0: no height, 1 m assumed: ")
    assert len(note) <= 72
    assert "--height" not in drawn(live_board([named(estimates[-1], "cam0", flags=())]))


def test_a_stream_whose_packets_are_refused_shows_the_reason(stream):
    board = Board()
    stream.refused(1_000_000, "events outside the sensor")
    board.on_status(stream_status("n1", stream))
    assert "events outside the sensor" in drawn(board)


def test_a_status_that_is_old_is_grey_and_says_since_when(stream):
    clock = Clock()
    board = Board(clock=clock)
    stream.refused(1_000_000, "events outside the sensor")
    board.on_status(stream_status("n1", stream))
    assert "no status since" not in drawn(board)
    clock.now += 20
    assert "no status since" in drawn(board)
    assert drawn(board, width=60).splitlines()[1].endswith("20 s ago")


def test_truth_stands_next_to_the_estimate_with_the_error(estimates):
    last = estimates[-1]
    board = live_board(estimates, truth=lambda one: one.twist._replace(vx=one.twist.vx - 0.25))
    text = drawn(board)
    assert "truth" in text
    (row,) = [row for row in text.splitlines() if "│ vx" in row]
    assert f"{last.twist.vx - 0.25:+7.3f}" in row
    assert "+0.250" in row


def test_a_line_has_the_newest_twist_and_its_sigma(estimates):
    covariance = [0.0] * 36
    covariance[0], covariance[35] = 0.0625, 0.04
    certain = estimates[-1].model_copy(update={"covariance": tuple(covariance)})
    text = lines.as_text(certain)
    assert f"vx={certain.twist.vx:+.3f}±0.250" in text
    assert f"wz={certain.twist.wz:+.3f}±0.200" in text
    found = lines.json.loads(lines.as_json(certain))
    assert found["twist"] == pytest.approx(certain.twist._asdict())
    assert (found["sigma"]["vx"], found["sigma"]["wz"]) == (0.25, pytest.approx(0.2))
    assert lines.json.loads(lines.as_json(estimates[-1]))["sigma"] is None


def test_a_stream_without_an_estimate_has_a_line_with_the_reason(stream):
    board = Board()
    board.on_status(stream_status("n1", stream))
    received = board.of("cam0")
    assert lines.of_stream("cam0", received, json_wanted=False).startswith("cam0 no estimate: ")
    assert lines.json.loads(lines.of_stream("cam0", received, json_wanted=True))["twist"] is None


def test_notices_tell_the_legend_once_and_the_begin_and_end_of_a_silence(estimates):
    clock = Clock()
    notices = lines.Notices(clock)
    steady = [named(one, "cam0", flags=("uncalibrated",)) for one in estimates]
    first = list(notices.arrived(steady[0]))
    assert "camera_optical" in first[0]
    assert first[1].startswith("cam0: no lens: ")
    assert list(notices.arrived(steady[1])) == []
    clock.now += 0.9
    assert list(notices.silent()) == []
    clock.now += 0.2
    (silence,) = notices.silent()
    assert silence.startswith("cam0: no estimate since ")
    assert list(notices.silent()) == []
    assert list(notices.arrived(steady[2])) == ["cam0: estimates again"]


def test_a_picture_of_the_newest_table_shows_a_live_stream(estimates):
    clock = Clock()
    board = live_board(estimates, clock)
    clock.now += 60
    assert "no estimate since" in drawn(board)
    assert "no estimate since" not in drawn(board.at_newest())


def test_the_picture_in_the_readme_shows_the_table_of_today(estimates):
    picture = Path(__file__).parents[3] / "service/pictures/demo.svg"
    words = html.unescape(" ".join(re.findall(r">([^<>]+)</text>", picture.read_text(encoding="utf-8"))))
    shown = words.replace("\xa0", " ").split()
    today = drawn(live_board(estimates[:1], truth=lambda one: one.twist), width=100)
    legend = today[today.index("vx vy vz in") :].split("cam0")[0].split()
    assert " ".join(legend) in " ".join(shown)
    for word in ("estimate", "truth", "error", "m/s", "rad/s", "estimates/s,", "ok", "lost:", "flags:"):
        assert word in shown
