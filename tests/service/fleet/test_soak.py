"""What answers and silence say about a node in its soak."""

import pytest

from neurove_protocol.control import HealthReply
from neurove_service.fleet.soak import Soak
from tests.service.metrics.test_families import reply

NEW = reply().model.digest


def heard(uptime_s=100.0, **fields) -> HealthReply:
    return reply(uptime_s=uptime_s, **fields)


@pytest.fixture
def soak():
    return Soak(NEW, began_s=1000.0, soak_s=60.0, grace_s=10.0, patience_s=30.0)


def test_a_node_is_fine_by_an_answer_at_the_end_of_its_soak_and_not_before(soak):
    assert soak.heard(heard(100.0), 1001.0).result == "soaking"
    assert soak.heard(heard(158.0), 1059.0).result == "soaking"
    assert soak.silent(1061.0, "is silent").result == "soaking"
    assert soak.heard(heard(161.0), 1062.0).result == "fine"


def test_a_node_that_is_silent_after_its_soak_fails(soak):
    soak.heard(heard(100.0), 1001.0)
    assert soak.silent(1089.0, "is silent").result == "soaking"
    found = soak.silent(1090.0, "is silent")
    assert (found.result, found.why) == ("failed", "is silent at the end of its soak; it was heard 89 s ago")


def test_a_node_that_serves_another_model_fails_at_once(soak):
    other = reply().model.model_copy(update={"digest": "ab" * 32, "name": "old"})
    found = soak.heard(heard(model=other, change="new was rolled back"), 1001.0)
    assert (found.result, found.why) == ("failed", "serves old (abababababab) again: new was rolled back")


@pytest.mark.parametrize(("uptime_s", "at_s"), [(1.0, 1002.0), (101.0, 1050.0)])
def test_a_process_that_started_again_fails(soak, uptime_s, at_s):
    soak.heard(heard(100.0), 1001.0)
    assert soak.heard(heard(uptime_s), at_s).why == "started again during its soak"


def test_an_answer_that_was_long_on_its_way_is_no_restart(soak):
    soak.heard(heard(100.0), 1001.0)
    assert soak.heard(heard(101.5), 1030.0, asked_s=1002.0).result == "soaking"


def test_an_automatic_rollback_between_two_answers_fails(soak):
    soak.heard(heard(100.0), 1001.0)
    assert soak.heard(heard(101.0, rollbacks=3, change="x"), 1002.0).why == "rolled back automatically: x"


def test_a_node_may_be_not_ok_for_the_grace_and_no_longer(soak):
    bad = {"ok": False, "why": "cam0 is lossy"}
    assert soak.heard(heard(100.0, **bad), 1001.0).result == "soaking"
    assert soak.heard(heard(109.0, **bad), 1010.0).result == "soaking"
    assert soak.heard(heard(110.0), 1011.0).result == "soaking"
    assert soak.heard(heard(160.0, **bad), 1061.0).result == "soaking"  # the soak is over, but it is not ok now
    assert soak.heard(heard(170.0, **bad), 1071.0).why == "not ok for 10 s: cam0 is lossy"


def test_a_restart_after_the_soak_is_no_failure(soak):
    assert soak.heard(heard(161.0), 1062.0).result == "fine"
    assert soak.heard(heard(1.0), 1100.0).result == "fine"
