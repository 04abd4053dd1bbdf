"""Probation after a model change, and the ways back: the estimates, window by window."""

import contextlib

import numpy as np
import pytest

from neurove_core.engine.array_runner import ArrayRunner
from neurove_protocol.errors import (
    NothingBefore,
    Untrained,
)
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.models.swapping import WINDOW_US, Live, feed, motion, steps, wait_until


@pytest.mark.parametrize("model", ["two", "wide", "short"])
def test_after_a_rollback_in_probation_the_estimates_are_those_of_a_run_that_never_swapped(slots, model):
    slot, packets = slots(), make_packets(400)
    never = {one.start_us: motion([one]) for one in feed(Stream("cam0", slots()), packets)}
    stream = Stream("cam0", slot)
    feed(stream, packets[:103])
    slot.activate(model)
    during = feed(stream, packets[103:260])
    slot.rollback()
    after = feed(stream, packets[260:])
    assert {one.model for one in during} == {model}
    assert len(after) >= 9
    for one in after:
        assert motion([one]) == never[one.start_us]
    assert {one.epoch for one in after} == {2}
    with pytest.raises(NothingBefore):
        slot.rollback()


def test_a_stream_that_begins_or_restarts_during_probation_is_rolled_back_exactly_too(slots):
    slot, first, second = slots(), make_packets(30), make_packets(100, start_us=10_011_000)
    slot.activate("wide")
    stream = Stream("cam0", slot)
    feed(stream, [*first, *second[:50]])
    slot.rollback()
    untouched = Stream("cam0", slots())
    feed(untouched, [*first, *second[:50]])
    assert motion(feed(stream, second[50:])) == motion(feed(untouched, second[50:]))


def test_a_rollback_after_probation_primes_the_old_model(slots):
    progress, slot, packets, kept = [], slots(probation_s=0.0), make_packets(200), []
    slot = slots(probation_s=0.0, on_changed=lambda model: kept.append(model.name))
    never = feed(Stream("cam0", slots()), packets)
    stream = Stream("cam0", slot)
    feed(stream, packets[:50])
    slot.activate("two")
    assert slot.await_probation(60)
    feed(stream, packets[50:100])
    assert stream.lanes.standby is None
    wait_until(lambda: kept == ["two"])
    taken, serving = slot.rollback(on_progress=progress.append)
    after = feed(stream, packets[100:])
    assert (taken.name, serving.estimator.bundle.name, steps(progress)[-1], kept) == (
        "two",
        "one",
        "rolled_back",
        ["two", "one"],
    )
    assert motion(after) == motion(never[-len(after) :])  # the ring has all windows so far: exact here


class NotFinite(ArrayRunner):
    """A model that computes nan."""

    def run(self, counts, states):
        return [(np.full_like(twists, np.nan), state) for twists, state in super().run(counts, states)]


class Poisoned:
    """Makes a running model fail: values that are not finite, or an exception, from now on."""

    def __init__(self, estimator, how):
        self.estimator, self.how = estimator, how

    def now(self):
        if self.how == "nan":
            model = self.estimator.bundle
            self.estimator.__init__(model, NotFinite(model.weights))
        else:
            self.estimator.follow = self._raise

    def _raise(self, *_):
        raise RuntimeError("planted")


@pytest.mark.parametrize(("how", "words"), [("nan", "not finite"), ("exception", "planted")])
@pytest.mark.parametrize("cut", [250, 251, 262])
def test_a_model_that_fails_on_probation_is_rolled_back_within_the_window(slots, how, words, cut):
    slot, packets, progress, kept = slots(), make_packets(400), [], []
    slot = slots(on_changed=lambda model: kept.append(model.name))
    never = {one.start_us: motion([one]) for one in feed(Stream("cam0", slots()), packets)}
    stream, other = Stream("cam0", slot), Stream("cam1", slot)
    feed(stream, packets[:100]), feed(other, make_packets(100, stream="cam1"))
    _, serving = slot.activate("two", on_progress=progress.append)
    during = feed(stream, packets[100:cut])
    Poisoned(serving.estimator, how).now()
    after = feed(stream, packets[cut:])
    assert {one.model for one in during} == {"two"}
    assert [one.start_us for one in after] == list(range(during[-1].end_us, after[-1].end_us, WINDOW_US))
    for one in after:
        assert motion([one]) == never[one.start_us]
    assert stream.counters.losses().nonzero() == {}
    wait_until(lambda: steps(progress)[-1] == "rolled_back")
    assert words in progress[-1].text
    assert "stream cam0" in slot.last_change
    assert (slot.rollbacks, kept, slot.active.estimator.bundle.name) == (1, ["one"], "one")
    assert {one.model for one in feed(other, make_packets(150, stream="cam1")[100:])} == {"one"}


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (TrialLimits(divergence=3.0, rate_ratio=1e9, latency_share=1e9), "divergence"),
        (TrialLimits(divergence=1e9, rate_ratio=1e9, latency_share=1e-9), "latency_ms"),
    ],
)
def test_a_model_that_breaks_a_limit_on_probation_is_rolled_back_automatically(slots, limits, words):
    slot, progress = slots(probation=limits), []
    stream = Stream("cam0", slot)
    with Live(stream, make_packets(4_000, n=50, step_us=25_000)) as live:
        wait_until(lambda: len(live.estimates) > 3)
        slot.activate("wild", on_progress=progress.append)
        wait_until(lambda: live.estimates[-1].epoch == 2 and steps(progress)[-1] == "rolled_back")
    assert words in slot.last_change
    assert live.estimates[-1].model == "one"
    assert [one.seq for one in live.estimates] == list(range(len(live.estimates)))


STRICT = TrialLimits(divergence=1e-6, rate_ratio=1.0, latency_share=1e9)


@pytest.fixture
def camera(slots):
    """Makes a running stream of a slot."""
    with contextlib.ExitStack() as stack:

        def make(slot):
            live = stack.enter_context(Live(Stream("cam0", slot), make_packets(4_000, n=50, step_us=25_000)))
            wait_until(lambda: len(live.estimates) > 3)
            return live

        yield make


@pytest.mark.parametrize("shadow_s", [0.0, 0.5])
@pytest.mark.parametrize("active", ["random", "similar"])
def test_a_model_without_a_proven_record_refuses_no_other_by_its_difference(slots, camera, active, shadow_s):
    slot, progress = slots(active, probation_s=0.3, probation=STRICT, shadow=STRICT), []
    camera(slot)
    slot.activate("two", shadow_s=shadow_s, on_progress=progress.append)
    wait_until(lambda: steps(progress)[-1] in ("done", "rolled_back"))
    assert (steps(progress)[-1], slot.active.estimator.bundle.name) == ("done", "two")
    why = {"random": "it is untrained", "similar": "its bundle has no golden test"}[active]
    assert f"judged by its own limits only: {active} has no proven record, because {why}" in "".join(
        one.text for one in progress if one.step == "probation"
    )


def test_a_model_is_a_measure_only_after_its_own_probation(slots, camera):
    slot, progress = slots("random", probation_s=0.3, probation=STRICT), []
    camera(slot)
    slot.activate("one", on_progress=progress.append)
    wait_until(lambda: steps(progress)[-1] == "done")
    slot.activate("two", on_progress=progress.append)
    wait_until(lambda: steps(progress)[-1] == "rolled_back")
    assert "divergence" in slot.last_change


def test_own_limits_refuse_absurd_speeds_without_a_comparison(slots, camera):
    slot, progress = slots("random", probation_s=60.0, probation=STRICT), []
    camera(slot)
    slot.activate("absurd", on_progress=progress.append)
    wait_until(lambda: steps(progress)[-1] == "rolled_back")
    assert "the bound is 200" in slot.last_change


def test_a_forced_change_is_not_refused_by_a_difference_and_its_reason_is_logged(slots, camera, capsys):
    slot, progress = slots(probation_s=0.3, probation=STRICT, shadow=STRICT), []
    camera(slot)
    slot.activate("wild", shadow_s=0.5, force="new gear ratio", on_progress=progress.append)
    assert "forced (new gear ratio): no difference from one refuses it" in slot.last_change
    wait_until(lambda: steps(progress)[-1] == "done")
    assert slot.active.estimator.bundle.name == "wild"
    assert "reason='new gear ratio'" in capsys.readouterr().out


def test_a_forced_change_does_not_overrule_a_fault(slots, camera):
    slot, progress = slots(), []
    camera(slot)
    _, serving = slot.activate("two", force="now", on_progress=progress.append)
    Poisoned(serving.estimator, "nan").now()
    wait_until(lambda: steps(progress)[-1] == "rolled_back")
    assert "not finite" in slot.last_change


def test_a_probation_without_windows_waits_for_them_and_says_so(slots):
    kept, progress = [], []
    slot = slots(probation_s=0.1, on_changed=lambda model: kept.append(model.name))
    slot.activate("two", on_progress=progress.append)
    wait_until(lambda: steps(progress)[-1] == "waiting")
    assert (kept, slot.plan.phase) == ([], "probation")
    assert slot.last_change == "two is active, but its probation waits for windows: 0 so far, at least 8 are needed"
    stream = Stream("cam0", slot)
    feed(stream, make_packets(40, n=50, step_us=25_000))
    wait_until(lambda: steps(progress)[-1] == "done")
    assert (kept, slot.last_change) == (["two"], "two is active: it passed its probation")
    assert steps(progress).count("waiting") == 1


def test_a_model_whose_probation_waits_serves_on_probation_after_a_restart(slots):
    kept, trials = [], []

    def on_trial(tried, proven):
        trials.append((tried and tried.name, proven.name))

    first = slots(probation_s=0.1, on_trial=on_trial)
    first.activate("two")
    wait_until(lambda: trials == [("two", "one")])
    one, two = first.previous.digest, first.active.estimator.bundle.digest
    first.close()
    again = slots(
        probation_s=0.1,
        kept=(one, None),
        trial=two,
        on_changed=lambda model: kept.append(model.name),
        on_trial=on_trial,
    )
    assert (again.active.estimator.bundle.name, again.previous.name, again.plan.phase) == ("two", "one", "probation")
    again.resume()
    wait_until(lambda: len(trials) == 2)
    stream = Stream("cam0", again)
    feed(stream, make_packets(40, n=50, step_us=25_000))
    wait_until(lambda: kept == ["two"])
    assert trials == [("two", "one"), ("two", "one"), (None, "one")]
    assert again.rollback()[1].estimator.bundle.name == "one"


def test_activating_the_active_model_changes_nothing_and_keeps_the_previous_one(slots):
    slot, progress = slots(), []
    slot.activate("two")
    digest = slot.active.estimator.bundle.digest
    before, plan = slot.previous, slot.plan
    for model, expect in (("two", None), (digest[:8], None), ("two", before.digest)):  # as a repeated roll-out does
        old, serving = slot.activate(model, expect=expect, on_progress=progress.append)
        assert (old.digest, serving.estimator.bundle.digest) == (digest, digest)
    assert (slot.plan, slot.previous) == (plan, before)
    assert steps(progress) == ["done"] * 3
    assert slot.rollback()[1].estimator.bundle.name == "one"


def test_a_node_for_trained_models_takes_no_untrained_one(slots, folder):
    slot = slots(trained_only=True)
    for model in ("random", "untrained"):
        with pytest.raises(Untrained, match=f"model {model}: it is untrained; a node with trusted_keys takes only"):
            slot.activate(model)
        with pytest.raises(Untrained):
            slots(model, trained_only=True)
    assert slot.active.epoch == 0
    other = slots()
    random = other.activate("random")[1].estimator.bundle.digest
    one = slot.active.estimator.bundle.digest
    again = slots("one", trained_only=True, kept=(random, random))
    assert (again.active.estimator.bundle.name, again.previous) == ("one", None)
    last = slots("one", kept=(one, random))
    assert last.previous.name == "random"


def test_a_node_that_serves_another_model_than_the_configured_one_says_so_first(slots, capsys):
    two = slots("two").active.estimator.bundle.digest
    capsys.readouterr()
    slots("one", kept=(two, None))
    first = capsys.readouterr().out.splitlines()[0]
    assert "another model than the configured one serves" in first
    assert "configured=one serving=two" in first


def test_an_untrained_model_that_answers_is_a_fault_of_the_node(slots):
    slot = slots()
    assert slot.faults == []
    slot.activate("random", canary=frozenset({"cam0"}))
    assert slot.faults == ["model random is untrained: its estimates have no meaning"]
    slot.rollback()
    assert slot.faults == []


def test_a_model_on_probation_passes_when_a_later_change_follows(slots):
    slot, progress = slots(), []
    slot.activate("two", on_progress=progress.append)
    slot.activate("three")
    wait_until(lambda: steps(progress)[-1] == "done")
    assert (slot.previous.name, slot.active.epoch) == ("two", 2)
    slot.fault(slot.active, "planted")
    assert slot.active.estimator.bundle.name == "two"


def test_a_fault_of_a_model_that_is_not_on_probation_changes_nothing(slots):
    slot = slots()
    slot.fault(slot.active, "planted")
    assert (slot.rollbacks, slot.active.epoch) == (0, 0)
