"""A model change while streams run: the estimates, window by window."""

import contextlib
import itertools
import threading
from dataclasses import replace

import pytest
import torch

from neurove_core.config import WindowConfig
from neurove_core.models import bundle
from neurove_protocol import Flag
from neurove_protocol.errors import (
    Conflict,
    Diverged,
    InternalError,
    InvalidField,
    NoMemory,
    NothingBefore,
    TooSlow,
    Untrained,
)
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.bundles import proven
from tests.service.conftest import SMALL, arrived

WINDOW_US = 50_000
LAX = TrialLimits(divergence=1e9, rate_ratio=1e9, latency_share=1e9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swap")
    for seed, name in ((1, "one"), (2, "two"), (3, "three")):
        bundle.save(proven(bundle.untrained(seed, SMALL, name)), folder / f"{name}.safetensors")
    one = bundle.load(folder / "one.safetensors")
    plain = replace(one, golden=None)  # the golden test is that of other scales
    bundle.save(replace(plain, name="similar", offset=torch.full((6,), 1e-4)), folder / "similar.safetensors")
    bundle.save(replace(plain, name="wild", scale=torch.full((6,), 50.0)), folder / "wild.safetensors")
    bundle.save(replace(plain, name="absurd", scale=torch.full((6,), 1e4)), folder / "absurd.safetensors")
    bundle.save(bundle.untrained(7, SMALL, "random"), folder / "random.safetensors")
    short = SMALL.model_copy(update={"window": WindowConfig(duration_us=20_000, bins=5)})
    bundle.save(bundle.untrained(4, short, "short"), folder / "short.safetensors")
    wide = SMALL.model_copy(update={"canonical": SMALL.canonical.model_copy(update={"width": 30})})
    bundle.save(bundle.untrained(5, wide, "wide"), folder / "wide.safetensors")
    return folder


class Slots:
    """Makes slots with the models of the folder, and closes them."""

    def __init__(self, folder):
        self.folder, self.made = folder, []

    def __call__(self, model="one", *, probation_s=60.0, probation=LAX, shadow=LAX, **arguments):
        rules = Rules(probation_s=probation_s, probation=probation, shadow=shadow)
        self.made.append(ModelSlot(model, self.folder, rules, **arguments))
        return self.made[-1]


@pytest.fixture
def slots(folder):
    made = Slots(folder)
    yield made
    for slot in made.made:
        slot.close()


def feed(stream, packets):
    estimates = []
    for packet in packets:
        estimates += stream.accept(packet, arrived())
        while packet.seq % 40 and stream.lanes.has_backlog:  # now and then the standby model lags
            stream.lanes.run_standby()
    return estimates


def motion(estimates):
    """The motion of the camera and the flags, without the model."""
    return [(one.start_us, one.end_us, one.twists, one.flags, one.events) for one in estimates]


class Live:
    """A stream that gets packets on a thread of its own during a change."""

    def __init__(self, stream, packets, pace_s=0.002):
        self.stream, self.packets, self.pace_s = stream, iter(packets), pace_s
        self.estimates, self._stop = [], threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        for packet in self.packets:
            self.estimates += feed(self.stream, [packet])
            if self._stop.wait(self.pace_s):
                return

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def wait_until(condition, timeout_s=20.0):
    for _ in range(int(timeout_s / 0.01)):
        if condition():
            return
        threading.Event().wait(0.01)
    pytest.fail(f"did not become true within {timeout_s} s")


def steps(progress):
    return [one.step for one in progress]


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
    assert slot.await_probation(10)
    wait_until(lambda: steps(progress)[-1] == "done")
    assert steps(progress) == [
        "verified", "loaded", "warmed", "priming", "priming", "active", "probation", "done",
    ]  # fmt: skip


def test_of_two_changes_at_once_the_second_is_refused_at_once(slots):
    slot, stuck, go = slots(), threading.Event(), threading.Event()

    def hold(one):
        if one.step == "loaded":
            stuck.set()
            go.wait(20)

    winner = threading.Thread(target=slot.activate, args=("two",), kwargs={"on_progress": hold})
    winner.start()
    assert stuck.wait(20)
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


# --- probation


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
    assert slot.await_probation(10)
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


class Poisoned:
    """Makes a running model fail: values that are not finite, or an exception, from now on."""

    def __init__(self, estimator, how):
        self.estimator, self.how = estimator, how

    def now(self):
        if self.how == "nan":
            self.estimator.network.readout.bias.data.fill_(float("nan"))
            self.estimator.__init__(replace(self.estimator.bundle, scale=torch.full((6,), float("nan"))))
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
        wait_until(lambda: live.estimates[-1].epoch == 2)
    assert words in slot.last_change
    assert steps(progress)[-1] == "rolled_back"
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
