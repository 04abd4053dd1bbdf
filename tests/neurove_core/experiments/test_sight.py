"""What a model sees: the changed events are what they claim, and the command says what the default model sees."""

import json

import numpy as np
import pytest

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.experiments import sight
from neurove_core.geometry.motion import Twists
from neurove_core.sim.render.camera import CAMERAS
from neurove_protocol import Events, Sensor
from tests.builders import make_events

WINDOW_US = 50_000


def sorted_places(events: Events) -> list[tuple[int, ...]]:
    return sorted(zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True))


@pytest.mark.parametrize("change", [sight.shuffled, sight.backwards])
def test_a_change_of_times_keeps_the_events_of_every_window(change):
    events = make_events(5000, duration_us=200_000)
    changed = change(events, WINDOW_US)
    assert (np.diff(changed.t) >= 0).all()
    for start in range(0, 200_000, WINDOW_US):
        a, b = (
            one.span(*(int(n) for n in one.t.searchsorted([start, start + WINDOW_US]))) for one in (events, changed)
        )
        assert a.n == b.n
        assert [row[1:] for row in sorted_places(a._replace(t=a.t * 0))] == [
            row[1:] for row in sorted_places(b._replace(t=b.t * 0))
        ]


def test_time_that_runs_backwards_twice_is_time_as_it_was():
    events = make_events(5000, duration_us=200_000)
    twice = sight.backwards(sight.backwards(events, WINDOW_US), WINDOW_US)
    assert sorted_places(twice) == sorted_places(events)


def test_a_faster_clock_scales_the_truth_alike():
    truth = Twists(np.array([0, 80_000]), np.array([[1.0] * 6, [2.0] * 6]))
    events, fast = sight.faster(make_events(500, duration_us=80_000), truth, 4)
    assert events.t.max() <= 20_000
    assert fast.t.tolist() == [0, 20_000]
    assert fast.twist[:, 0].tolist() == [4.0, 8.0]


def row(shuffled: float, reverse: float, slow: bool = False, now: float = 1.0, fast: float = 1.0):
    shares = {sight.AS_IS: now, sight.SHUFFLED: shuffled, sight.REVERSED: reverse, "2x": 1.0, "4x": fast, "8x": 1.0}
    cells = {name: {"share": share, "correlation": None, "windows": 9} for name, share in shares.items()}
    return {"case": "one", "slow": slow} | cells


@pytest.mark.parametrize(
    ("shuffled", "reverse", "says"),
    [
        (0.02, -0.9, "sees the order of the events within a window and little else"),
        (0.02, 0.1, "sees more than their order"),
        (0.95, 0.9, "does not use the times"),
        (0.5, 0.4, "in part"),
    ],
)
def test_the_sentence_says_what_is_lost(shuffled, reverse, says):
    assert says in sight.sentence([row(shuffled, reverse)])
    assert f"{shuffled:.0%} of the motion" in sight.sentence([row(shuffled, reverse)])


def test_the_sentence_compares_slow_motion_with_a_faster_clock():
    text = sight.sentence([row(0, -1), row(0, 0, slow=True, now=0.5, fast=0.9)])
    assert "slow motion is off by 50%, and by 10% with the clock run four times as fast" in text
    assert "none of these motions" in sight.sentence([row(0, 0, now=0.1)])


def test_the_default_model_sees_the_order_of_events_within_a_window(run, tmp_path):
    code, out, _ = run("reproduce", "sight", "--quick", "--out", tmp_path)
    assert code == 0
    assert out == (tmp_path / "sight.md").read_text()
    results = json.loads((tmp_path / "sight.json").read_text())
    assert (tmp_path / "sight.png").stat().st_size > 10_000
    drive = results["cases"][0]
    assert drive["as recorded"]["share"] == pytest.approx(1, abs=0.2)
    assert abs(drive["shuffled"]["share"]) < 0.5  # longer windows keep the order of the windows in them
    assert drive["reversed"]["share"] < -0.4
    assert results["sentence"] in out


def test_a_recording_of_one_settled_window_gives_no_share():
    sensor = Sensor(240, 180)
    events = make_events(5000, duration_us=590_000, sensor=sensor)
    still = Twists(np.arange(0, 700_000, 10_000), np.ones((70, 6)))
    case = sight.Case("short", events, CAMERAS["davis240c"], still, (4,), slow=False)
    assert sight.see(Estimator(models.find("default")), case, sight.AS_IS).share is None
