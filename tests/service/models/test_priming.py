"""Priming of a new model on streams with packets: in spare time, before it serves."""

import threading
import time
from dataclasses import replace

import pytest
import torch

from neurove_core.config import ModelConfig
from neurove_core.models import bundle
from neurove_core.models.metadata import Metadata
from neurove_protocol.errors import Diverged
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.history import RingSize
from neurove_service.streams.lane import windows_to_prime
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import SMALL, arrived
from tests.service.models.swapping import LAX, feed, motion, wait_until

PACKETS = make_packets(6_000, n=50, step_us=25_000)
FEW = RingSize(8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("priming")
    one, two = (bundle.untrained(seed, SMALL, name) for seed, name in ((1, "one"), (2, "two")))
    for model in (
        one,
        two,
        replace(two, name="patient", metadata=Metadata(prime_windows=40)),
        replace(two, name="hasty", metadata=Metadata(prime_windows=2)),
        bundle.untrained(5, ModelConfig(**{**SMALL.model_dump(), "kind": "ann"}), "ann"),
    ):
        bundle.save(model, folder / f"{model.name}.safetensors")
    return folder


@pytest.fixture
def slots(folder):
    made = []

    def make(model="one", **rules):
        made.append(ModelSlot(model, folder, Rules(shadow=LAX, probation=LAX, **rules)))
        return made[-1]

    yield make
    for slot in made:
        slot.close()


class Camera:
    """Runs a stream as its worker does: packets as they arrive, the standby model in between."""

    def __init__(self, slot, name="cam0", ring=RingSize()):  # noqa: B008  # immutable
        self.stream, self.estimates = Stream(name, slot, ring=ring), []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        for packet in PACKETS:
            self.estimates += self.stream.accept(replace(packet, stream=self.stream.name), arrived())
            until = time.monotonic() + 0.003
            while self.stream.lanes.has_backlog and time.monotonic() < until:
                self.stream.lanes.run_standby()
            if self._stop.wait(max(0.0, until - time.monotonic())):
                return

    def __enter__(self):
        self._thread.start()
        wait_until(lambda: len(self.estimates) > 20)
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def never_swapped(slots, model, windows):
    return feed(Stream("cam0", slots(model)), PACKETS[: 2 * (windows + 1)])[:windows]


def test_a_primed_model_answers_from_its_first_window_as_if_it_had_always_served(slots):
    progress, slot = [], slots()
    with Camera(slot) as camera:
        slot.activate("two", on_progress=progress.append)
        wait_until(lambda: camera.estimates[-1].model == "two")
    expected = never_swapped(slots, "two", len(camera.estimates))
    new = [at for at, one in enumerate(camera.estimates) if one.model == "two"]
    assert motion([camera.estimates[at] for at in new]) == motion([expected[at] for at in new])
    assert [one.seq for one in camera.estimates] == list(range(len(expected)))
    assert "1 streams replayed" in [one.text for one in progress if one.step == "priming"][-1]


def test_a_promoted_canary_is_first_primed_in_standby_on_all_other_streams(slots):
    slot = slots()
    with Camera(slot) as a, Camera(slot, "cam1") as b:
        slot.activate("two", canary=frozenset({"cam0"}))
        wait_until(lambda: a.estimates[-1].model == "two")
        assert b.estimates[-1].model == "one"
        slot.activate("two")
        wait_until(lambda: b.estimates[-1].model == "two")
    expected = never_swapped(slots, "two", len(b.estimates))
    new = [at for at, one in enumerate(b.estimates) if one.model == "two"]
    assert [b.estimates[at].twists for at in new] == [expected[at].twists for at in new]


def test_a_bundle_sets_the_number_of_windows_that_prime_it(slots):
    wanted = {model: windows_to_prime(slots(model).active.estimator) for model in ("two", "patient", "hasty")}
    assert wanted == {"two": 64, "patient": 40, "hasty": 2}


def test_a_bundle_that_needs_more_windows_than_are_kept_waits_for_live_ones(slots):
    slot = slots()
    with Camera(slot, ring=FEW) as camera:
        before = len(camera.estimates)
        slot.activate("patient")
        wait_until(lambda: camera.estimates[-1].model == "patient")
    old = sum(one.model == "one" for one in camera.estimates)
    assert old - before >= 40 - FEW.windows - 4  # windows that arrive during loading are kept too


def test_prime_s_bounds_the_wait_for_windows(slots):
    slot = slots(prime_s=0.0)
    with Camera(slot, ring=FEW) as camera:
        slot.activate("patient")
        wait_until(lambda: camera.estimates[-1].model == "patient")
        assert slot.active.estimator.bundle.name == "patient"


@pytest.mark.parametrize("how", ["exception", "nan"])
def test_a_model_that_fails_during_priming_is_refused_and_leaves_no_trace(slots, how):
    slot, steps = slots(), []

    def spoil(progress):
        steps.append(progress.step)
        if progress.step == "priming" and "streams replayed" not in progress.text:
            follow = type(slot.active.estimator).follow

            def bad(self, windows, state):
                if self.bundle.name != "two":
                    return follow(self, windows, state)
                if how == "exception":
                    raise RuntimeError("planted")
                estimates, state = follow(self, windows, state)
                return [one._replace(twists=one.twists * float("nan")) for one in estimates], state

            patch.setattr(type(slot.active.estimator), "follow", bad)

    with pytest.MonkeyPatch.context() as patch, Camera(slot) as camera:
        with pytest.raises(Diverged, match="planted" if how == "exception" else "not finite"):
            slot.activate("two", on_progress=spoil)
        count = len(camera.estimates)
        wait_until(lambda: len(camera.estimates) > count + 3)
    assert steps[-1] == "refused"
    assert (slot.plan.phase, slot.active.epoch) == ("steady", 0)
    assert {one.model for one in camera.estimates} == {"one"}
    assert camera.stream.lanes.standby is None


def test_a_model_without_spikes_replaces_one_with_spikes_and_is_rolled_back(slots):
    slot = slots()
    with Camera(slot) as camera:
        slot.activate("ann")
        wait_until(lambda: camera.estimates[-1].model == "ann")
        slot.rollback()
        wait_until(lambda: camera.estimates[-1].epoch == 2)
    for model in ("one", "ann"):
        expected = never_swapped(slots, model, len(camera.estimates))
        at = [i for i, one in enumerate(camera.estimates) if one.model == model]
        got = torch.tensor([[list(twist) for twist in camera.estimates[i].twists] for i in at])
        torch.testing.assert_close(got, torch.tensor([[list(twist) for twist in expected[i].twists] for i in at]))
    assert [one.seq for one in camera.estimates] == list(range(len(camera.estimates)))
