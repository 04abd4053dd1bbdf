"""The built-in pattern: a sliding texture that needs no recording."""

import itertools

import numpy as np
import pytest

from neurove_core.io import Recording
from neurove_core.io.formats.pattern import FRAME_US, shift_px
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import check_events
from tests.recordings import assert_same


def seconds(recording: Recording, duration_s: float) -> Events:
    chunks = itertools.takewhile(lambda chunk: chunk.t[0] < duration_s * 1e6, recording.chunks())
    return Events.join(list(chunks))


@pytest.mark.parametrize("seed", range(3))
def test_the_pattern_repeats_for_a_seed_and_gives_valid_events_at_a_typical_rate(seed):
    recording = open_source(f"pattern://?seed={seed}")
    assert recording.endless
    events = seconds(recording, 1.0)
    assert_same(seconds(open_source(f"pattern://?seed={seed}"), 1.0), events)
    assert seconds(open_source("pattern://?seed=9"), 0.1).n != seconds(recording, 0.1).n
    check_events(events, recording.sensor, 0)
    assert 0 <= events.t[0] < 1000
    assert recording.sensor == Sensor(173, 130)
    assert 100_000 < events.n < 400_000
    assert 0.3 < events.p.mean() < 0.7


@pytest.mark.parametrize("seed", range(3))
def test_the_pattern_moves_along_its_stated_path(seed):
    """Events shifted back along the path give a sharper image than unshifted events or the opposite shift."""
    events = seconds(open_source(f"pattern://?seed={seed}"), 0.2)
    path = np.array([shift_px(t) for t in events.t.tolist()])

    def sharpness(direction: int) -> float:
        x, y = np.rint(np.stack([events.x, events.y], 1) - direction * path).astype(int).T
        image = np.zeros((260, 346))
        np.add.at(image, (y + 65, x + 86), np.where(events.p, 1, -1))
        return float(np.var(image))

    assert sharpness(1) > 1.5 * max(sharpness(0), sharpness(-1))


def test_the_times_of_the_pattern_do_not_show_its_frames():
    events = seconds(open_source("pattern://"), 0.5)
    share = np.histogram(events.t % FRAME_US, 5)[0] / events.n
    assert (np.abs(share - 0.2) < 0.02).all()


def test_the_pattern_has_the_lens_of_half_a_davis346():
    camera = open_source("pattern://").camera("cam0")
    assert camera is not None
    assert (camera.sensor, camera.lens, camera.distortion) == (Sensor(173, 130), "pinhole", ())
    assert (camera.cx, camera.cy) == (86, 64.5)
    assert camera.fx == camera.fy == pytest.approx(113.19)


def test_the_pattern_supports_another_sensor():
    recording = open_source("pattern://?seed=1", Sensor(64, 48))
    check_events(seconds(recording, 0.1), Sensor(64, 48), 0)
    camera = recording.camera("cam0")
    assert camera is not None
    assert camera.sensor == Sensor(64, 48)


@pytest.mark.parametrize("seed", ["", "-1", "x", "1.5", "99999999999999999999"])
def test_a_seed_that_is_not_a_whole_number_is_refused(seed):
    with pytest.raises(InvalidField, match="seed="):
        open_source(f"pattern://?seed={seed}")


def test_a_shift_that_rounds_to_a_whole_period_is_no_shift(monkeypatch):
    def shift(t_us):
        return (3.3e-16, 3.3e-16) if t_us == 0 else (1e-3 * t_us, 0.0)  # the first in x, after 203 s

    monkeypatch.setattr("neurove_core.io.formats.pattern.shift_px", shift)
    assert next(iter(open_source("pattern://").chunks())).n > 0
