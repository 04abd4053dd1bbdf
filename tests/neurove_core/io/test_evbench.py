"""eventVision-evbench: real recordings, their only reliable ground truth, and refused files."""

import numpy as np
import pytest
import scipy.io

from neurove_core.io import UnknownSource
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.recordings import assert_same, put, read, read_broken, shared

TRUTH = b"Ground-truth: seq_0001,seq_0002\nrvec (rad/frame)\nrvec =  0.0071  0.1 0.1\nrvec = -0.0142 0 0\n"


def put_mat(folder, name="seq_0002_e.mat", **columns) -> str:
    columns = {"ts": [5, 6, 9], "x": [1, 2, 3], "y": [179, 0, 9], "pol": [1, 0, 1]} | columns
    scipy.io.savemat(folder / name, {key: np.array(value)[:, None] for key, value in columns.items()})
    return str(folder / name)


@pytest.mark.parametrize(
    ("name", "n", "duration_s", "w_x"), [("seq_0001_e", 132_784, 1.069, 0.142), ("seq_0002_e", 273_143, 2.140, -0.142)]
)
def test_a_real_recording_has_its_known_events_and_its_flow_has_the_sign_of_its_truth(name, n, duration_s, w_x):
    recording = open_source(str(shared(f"evbench/{name}.mat")))
    assert recording.sensor == Sensor(240, 180)
    assert recording.streams == ("events", "twists")
    events = read(recording)
    assert events.n == n
    assert (events.t[-1] - events.t[0]) / 1e6 == pytest.approx(duration_s, abs=1e-3)
    twists = recording.twists()
    assert twists is not None
    assert twists.t.tolist() == [events.t[0], events.t[-1]]
    assert twists.twist[:, 3] == pytest.approx(w_x)
    assert np.isnan(np.delete(twists.twist, 3, axis=1)).all()
    # y points down: for a positive rate about x the image moves along +y
    assert np.sign(best_vertical_flow(events)) == np.sign(w_x)


def best_vertical_flow(events: Events) -> float:
    """The velocity in y [px/s] that gives the sharpest image of 0.3 s of these events."""
    events = events.span(0, int(np.searchsorted(events.t, events.t[0] + 300_000)))
    hot = np.bincount(events.y.astype(int) * 240 + events.x, minlength=240 * 180) > 200
    seen = ~hot[events.y.astype(int) * 240 + events.x]
    age_s = (events.t - events.t[0]) * 1e-6

    def sharpness(flow: float) -> float:
        row = np.rint(events.y - flow * age_s).astype(int) + 40
        return float(np.var(np.bincount((row * 240 + events.x)[seen], minlength=260 * 240)))

    return max(np.arange(-60.0, 61, 20), key=sharpness)


def test_y_is_flipped_and_the_truth_is_that_of_the_sequence(tmp_path):
    put(tmp_path, "ground-truth_3Dcam.txt", TRUTH)
    recording = open_source(put_mat(tmp_path))
    assert_same(read(recording), Events.from_columns([5, 6, 9], [1, 2, 3], [0, 179, 170], [1, 0, 1]))
    twists = recording.twists()
    assert twists is not None
    assert twists.twist[0, 3] == pytest.approx(-0.284)
    assert open_source(put_mat(tmp_path, "seq_0003_e.mat")).twists() is None


def test_a_folder_without_the_truth_file_has_no_twists(tmp_path):
    recording = open_source(put_mat(tmp_path))
    assert recording.streams == ("events",)
    assert recording.twists() is None


@pytest.mark.parametrize(
    "bad", [{"x": [1, 2, 240]}, {"y": [0, 0, 180]}, {"y": [0, 0, -1]}, {"pol": [1, 1, 2]}, {"ts": [5, 6, 5]}]
)
def test_events_before_an_invalid_one_are_read(bad, tmp_path):
    events, error = read_broken(open_source(put_mat(tmp_path, **bad)))
    assert events.n == 2
    assert error is not None
    assert error.details["where"] == "event 2"


def test_another_file_is_refused(tmp_path):
    with pytest.raises(UnknownSource, match="does not have the columns ts, x, y, pol"):
        open_source(put_mat(tmp_path, x=[1, 2]))
    for data in (b"", b"not a MATLAB file" * 20):
        with pytest.raises(UnknownSource, match="cannot be read as a MATLAB 5 file"):
            open_source(put(tmp_path, "a.mat", data))
