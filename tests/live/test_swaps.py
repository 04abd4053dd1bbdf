"""Model changes with a live data feed, in seconds; tests/long/swaps.py is the long run."""

import pytest

from tests.long.swaps import run

pytestmark = pytest.mark.live


def test_model_changes_under_load_answer_every_window_once_and_bad_models_are_refused():
    report = run(swaps=6, bad=2, streams=2, quiet_s=1.0)
    assert report["lost_or_doubled"] == 0, report
    assert report["lost"] == {"cam0": {}, "cam1": {}}
    assert report["epochs"] == 4
    assert report["rollbacks"] == 0
    assert "bad_model" in report["refused"]["truncated"]
    assert not report["not_refused"]
    assert not report["active_is_wrong"]
