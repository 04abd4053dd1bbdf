"""Changes of model under a live feed, in small; tests/long/swaps.py is the same at length."""

import pytest

from tests.long.swaps import run

pytestmark = pytest.mark.live


def test_changes_under_load_lose_and_double_no_window_and_bad_models_are_refused():
    told = run(swaps=6, bad=2, streams=2, quiet_s=1.0)
    assert told["lost_or_doubled"] == 0, told
    assert told["lost"] == {"cam0": {}, "cam1": {}}
    assert told["epochs"] == 4
    assert told["rollbacks"] == 0
    assert "bad_model" in told["refused"]["truncated"]
    assert not told["not_refused"]
    assert not told["active_is_wrong"]
