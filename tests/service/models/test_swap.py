"""A model change while streams run: the switch, canary, shadow and admission; the estimates, window by window."""

import itertools
import threading

import pytest

from neurove_protocol import Flag
from neurove_protocol.errors import (
    Conflict,
    Diverged,
    InternalError,
    InvalidField,
    NoMemory,
    TooSlow,
)
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import arrived
from tests.service.models.swapping import WINDOW_US, Live, feed, motion, steps, wait_until

# --- the switch


def test_the_old_model_answers_every_window_before_the_change_and_the_new_one_every_later_window(slots):
    packets, slot = make_packets(200), slots()
    expected = feed(Stream("cam0", slots("two")), packets)
    stream = Stream("cam0", slot)
    before = feed(stream, packets[:107])
    slot.activate("two")
    after = feed(stream, packets[107:])
    assert [one.start_us for one in before + after] == [one.start_us for one in expected]
    assert [one.seq for one in before + after] == list(range(len(expected)))
    assert {(one.model, one.epoch) for one in before} == {("one", 0)}
    assert {(one.model, one.epoch) for one in after} == {("two", 1)}
    assert motion(after) == motion(expected[len(before) :])  # as if it had always served: here bit for bit
    assert stream.counters.losses().nonzero() == {}


def test_a_change_reports_every_step(slots):
    progress, slot = [], slots(probation_s=0.5)
    stream, packets = Stream("cam0", slot), make_packets(300)
    feed(stream, packets[:100])
    slot.activate("two", on_progress=progress.append)
    feed(stream, packets[100:])
    assert slot.await_probation(60)
    wait_until(lambda: steps(progress)[-1] == "done")
    assert steps(progress) == [
        "verified", "loaded", "warmed", "priming", "priming", "active", "probation", "done",
    ]  # fmt: skip


def test_of_two_changes_at_once_the_second_is_refused_at_once(slots):
    slot, stuck, go = slots(), threading.Event(), threading.Event()

    def hold(one):
        if one.step == "loaded":
            stuck.set()
            go.wait(60)

    winner = threading.Thread(target=slot.activate, args=("two",), kwargs={"on_progress": hold})
    winner.start()
    assert stuck.wait(60)
    progress = []
    with pytest.raises(Conflict, match="another model change is in progress"):
        slot.activate("three", on_progress=progress.append)
    with pytest.raises(Conflict):
        slot.rollback()
    assert steps(progress) == ["refused"]
    go.set()
    winner.join()
    assert slot.active.estimator.bundle.name == "two"


def test_a_change_that_expects_another_model_is_refused(slots):
    slot = slots()
    digest = slot.active.estimator.bundle.digest
    with pytest.raises(Conflict, match="expected ffffffff to be active, but one"):
        slot.activate("two", expect="ffffffff")
    with pytest.raises(InvalidField, match="expect='abc': at least 8 digits"):
        slot.activate("two", expect="abc")
    with pytest.raises(Conflict):
        slot.rollback(expect="ffffffff")
    assert slot.activate("two", expect=digest[:8])[1].epoch == 1


@pytest.mark.parametrize("model", ["wide", "short"])
def test_a_model_with_other_windows_starts_cold_in_standby_and_then_answers_every_window(slots, model):
    progress, slot = [], slots()
    stream = Stream("cam0", slot)
    with Live(stream, make_packets(4_000, n=50, step_us=25_000), 0.002) as live:
        wait_until(lambda: len(live.estimates) > 3)
        slot.activate(model, on_progress=progress.append)
        wait_until(lambda: live.estimates[-1].model == model)
        slot.rollback()
        wait_until(lambda: live.estimates[-1].model == "one")
    assert any("starts cold" in one.text for one in progress)
    ends, starts = [one.end_us for one in live.estimates], [one.start_us for one in live.estimates]
    assert all(
        start >= end for end, start in itertools.pairwise([0, *itertools.chain(*zip(starts, ends, strict=True))])
    )
    new = [one for one in live.estimates if one.model == model]
    assert Flag.RESET not in new[0].flags
    if model == "wide":  # its windows are those of the old model: none is lost or answered twice
        assert starts == list(range(0, len(starts) * WINDOW_US, WINDOW_US))
        assert stream.counters.skipped_windows == 0


def test_a_model_with_other_windows_begins_with_a_complete_window_on_a_new_stream(slots):
    slot, packets = slots(), make_packets(300)
    slot.activate("two")  # no stream yet
    stream = Stream("cam0", slot)
    feed(stream, packets[:110])
    slot.activate("wide")
    after = feed(stream, packets[110:])
    assert after[0].start_us % WINDOW_US == 0
    assert after[0].start_us >= 110 * 4000
    assert {Flag.RESET, Flag.SETTLING} <= set(after[0].flags)
    assert stream.counters.losses().nonzero() == {"skipped_windows": 1}


# --- canary


def test_a_canary_serves_only_the_named_streams_until_it_is_promoted(slots):
    slot, packets, progress = slots(), make_packets(300), []
    a, b = Stream("cam0", slot), Stream("cam1", slot)
    others = make_packets(300, stream="cam1")
    feed(a, packets[:50]), feed(b, others[:50])
    slot.activate("two", canary=frozenset({"cam0", "cam9"}), on_progress=progress.append)
    assert "these streams do not exist yet: ['cam9']" in next(one.text for one in progress if one.step == "active")
    assert {one.model for one in feed(a, packets[50:100])} == {"two"}
    assert {one.model for one in feed(b, others[50:100])} == {"one"}
    assert slot.active.estimator.bundle.name == "one"
    with pytest.raises(Conflict, match="a canary of two"):
        slot.activate("three")
    slot.activate("two")
    expected = feed(Stream("cam1", slots("two")), others)
    both = feed(a, packets[100:]), feed(b, others[100:])
    assert {one.model for one in [*both[0], *both[1]]} == {"two"}
    assert [one.twists for one in both[1]] == [one.twists for one in expected[-len(both[1]) :]]
    assert (slot.active.estimator.bundle.name, slot.previous.name) == ("two", "one")


def test_a_canary_that_is_rolled_back_leaves_no_trace_in_the_estimates(slots):
    slot, packets = slots(), make_packets(300)
    never = feed(Stream("cam0", slots()), packets)
    stream = Stream("cam0", slot)
    before = feed(stream, packets[:100])
    slot.activate("two", canary=frozenset({"cam0"}))
    during = feed(stream, packets[100:200])
    taken, serving = slot.rollback()
    assert (taken.name, serving.estimator.bundle.name) == ("two", "one")
    after = feed(stream, packets[200:])
    assert motion(before + after) == motion(never[: len(before)] + never[len(before) + len(during) :])


# --- shadow


def test_a_shadow_changes_no_estimate_and_a_model_that_agrees_is_activated(slots):
    slot, progress = slots(shadow=TrialLimits(divergence=0.05, latency_share=1e9)), []
    packets = make_packets(4_000, n=50, step_us=25_000)
    stream = Stream("cam0", slot)
    with Live(stream, packets) as live:
        wait_until(lambda: len(live.estimates) > 3)
        slot.activate("similar", shadow_s=1.0, on_progress=progress.append)
        wait_until(lambda: live.estimates[-1].model == "similar")
    old = [one for one in live.estimates if one.model == "one"]
    never = feed(Stream("cam0", slots()), packets[: 2 * (len(old) + 2)])
    assert motion(old) == motion(never[: len(old)])
    assert [one.seq for one in live.estimates] == list(range(len(live.estimates)))
    assert "divergence" in [one.text for one in progress if one.step == "shadow"][-1]


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (TrialLimits(divergence=1.0, latency_share=1e9), "divergence on stream cam0"),
        (TrialLimits(divergence=1e9, latency_share=1e-9), "latency_ms on stream cam0"),
    ],
)
def test_a_model_that_breaks_a_limit_in_shadow_is_refused_with_the_figure_and_nothing_changes(slots, limits, words):
    slot, progress = slots(shadow=limits), []
    stream, packets = Stream("cam0", slot), make_packets(4_000, n=50, step_us=25_000)
    with Live(stream, packets) as live:
        wait_until(lambda: len(live.estimates) > 3)
        with pytest.raises(Diverged, match=words):
            slot.activate("wild", shadow_s=1.0, on_progress=progress.append)
        count = len(live.estimates)
        wait_until(lambda: len(live.estimates) > count + 3)
    assert steps(progress)[-1] == "refused"
    assert {(one.model, one.epoch) for one in live.estimates} == {("one", 0)}
    assert not stream.lanes.has_backlog
    assert slot.previous is None


def test_a_shadow_without_streams_is_refused(slots):
    with pytest.raises(Diverged, match="compared windows=0: the bound is at least 8"):
        slots().activate("two", shadow_s=0.01)


def test_a_refused_shadow_of_a_model_with_other_windows_leaves_nothing_running(slots):
    slot = slots()
    with pytest.raises(Diverged):
        slot.activate("wide", shadow_s=0.01)
    assert (slot.plan.phase, slot.active.epoch) == ("steady", 0)


def test_a_progress_callback_that_raises_leaves_nothing_running(slots):
    slot = slots()

    def raises(one):
        if one.step == "shadow":
            raise RuntimeError("planted")

    with pytest.raises(InternalError):
        slot.activate("two", shadow_s=0.01, on_progress=raises)
    assert slot.plan.phase == "steady"
    assert slot.activate("three")[1].epoch == 1


def test_a_shadow_that_the_node_has_no_time_for_stops_and_the_stream_continues(slots):
    slot = slots()
    stream, packets = Stream("cam0", slot), make_packets(9_000, n=5)
    feed(stream, packets[:50])
    result = []

    def activate():
        try:
            slot.activate("two", shadow_s=20)
        except Diverged as error:
            result.append(error)

    change = threading.Thread(target=activate)
    change.start()
    wait_until(lambda: slot.plan.phase == "shadow")
    estimates = [one for packet in packets[50:] for one in stream.accept(packet, arrived())]  # never a pause
    change.join()
    assert "fell behind" in result[0].message
    assert [one.start_us for one in estimates] == list(range(estimates[0].start_us, estimates[-1].end_us, WINDOW_US))
    assert {one.model for one in estimates} == {"one"}


# --- admission


def test_a_model_that_might_not_fit_into_memory_is_refused_before_it_is_loaded(slots):
    slot = slots(free_bytes=lambda: 1000)
    with pytest.raises(NoMemory, match="free_bytes=1000: a model change needs"):
        slot.activate("two")
    assert slot.active.epoch == 0


def test_a_model_that_the_node_cannot_run_in_time_is_refused_with_the_figure(folder):
    slot = ModelSlot("one", folder, Rules(warm_up_share=1e-6))
    with pytest.raises(TooSlow, match="p99_ms="):
        slot.activate("two")
    assert slot.active.estimator.bundle.name == "one"
