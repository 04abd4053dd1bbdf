"""Refinement on a stream: the same for any packets, left out and counted where the node is behind, not of a model."""

import itertools

import numpy as np
import pytest

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.ingest.wire import read_packet
from neurove_protocol import EventPacket
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.cli.estimating import OneModel
from neurove_service.guard import Guard
from neurove_service.node.health import stream_status
from neurove_service.streams.intake import Arrival
from neurove_service.streams.roles import Roles, Serving
from neurove_service.streams.stream import UNREFINED_NS, Stream
from tests.neurove_core.evaluation.test_contrast import of_rotation
from tests.neurove_core.geometry.test_geometry import ECD

CAMERA = ECD.model_copy(update={"stream": "cam0", "height_m": 1.0})
W = np.array([0.1, -0.6, 0.05])
EVENTS = of_rotation(CAMERA, W, 0.31, points=6000)


@pytest.fixture(scope="module")
def estimator():
    return Estimator(models.find("default"), refine=True)


def stream_of(source):
    stream = Stream("cam0", source)
    stream.set_camera(CAMERA)
    return stream


def packets(step_us):
    cuts = np.searchsorted(EVENTS.t, np.arange(0, 310_000 + step_us, step_us))
    for seq, (first, stop) in enumerate(itertools.pairwise(cuts)):
        yield EventPacket("cam0", seq, CAMERA.sensor, seq * step_us, EVENTS.span(first, stop))


def answered(stream, step_us=10_000, waited_ns=0):
    arrival = Arrival(1_000_000_000, 1_000_000_000 + waited_ns)
    found = [one for packet in packets(step_us) for one in stream.accept(packet, arrival)]
    return [one.model_copy(update={"trace": None, "host": None}) for one in found]


def test_the_estimates_of_a_turning_camera_are_refined_and_say_so(estimator):
    found = answered(stream_of(OneModel(estimator)))
    assert {one.source for one in found[1:]} == {"refined"}
    for one in found[1:]:
        assert np.linalg.norm(np.array(one.twist[3:]) - W) < 0.06
        np.linalg.cholesky(np.reshape(one.covariance, (6, 6)))


def test_the_refined_estimates_do_not_depend_on_the_packets(estimator):
    whole = answered(stream_of(OneModel(estimator)))
    assert answered(stream_of(OneModel(estimator)), step_us=1_000) == whole
    stream, limits, ns = stream_of(OneModel(estimator)), PacketLimits(), 1_000_000_000
    wire = [encode_packet(packet) for packet in packets(500)]
    found, first = stream.accept(read_packet(wire[0], limits), Arrival(ns, ns)), 1
    while first < len(wire):
        run = stream.collect(wire[first : first + 64], limits)
        if run is None:
            found += stream.accept(read_packet(wire[first], limits), Arrival(ns, ns))
            first += 1
        else:
            found += stream.accept_run(run, Arrival(ns, ns))
            first += len(run.marks)
    assert [one.model_copy(update={"trace": None, "host": None}) for one in found] == whole


def test_a_refinement_that_fails_leaves_the_answer_of_the_model_and_is_counted(estimator, monkeypatch):
    plain = answered(stream_of(OneModel(Estimator(estimator.bundle))))
    guard = Guard()
    stream = Stream("cam0", OneModel(estimator), guard=guard)
    stream.set_camera(CAMERA)
    monkeypatch.setattr(estimator, "refine", lambda *_: 1 / 0)
    found = answered(stream)
    assert [(one.twists, one.flags, one.source) for one in found] == [
        (one.twists, one.flags, "network") for one in plain
    ]
    status = stream_status("edge", stream, 0)
    assert (status.unrefined_windows, status.resets, status.lost.nonzero()) == (6, 0, {})
    assert guard.counts == {"refinement": 6}


def test_a_stream_that_is_behind_leaves_out_the_refinement_and_counts_it(estimator):
    stream = stream_of(OneModel(estimator))
    found = answered(stream, waited_ns=UNREFINED_NS + 1)
    assert {one.source for one in found} == {"network"}
    status = stream_status("edge", stream, 0)
    assert (status.unrefined_windows, status.windows) == (6, 6)
    assert status.lost.nonzero() == {}
    plain = answered(stream_of(OneModel(Estimator(models.find("default")))))
    assert found == plain


def test_without_a_lens_or_against_the_bundle_nothing_is_refined(estimator):
    unknown = Stream("cam0", OneModel(estimator))
    assert {one.source for one in answered(unknown)} == {"network"}
    bundle = models.find("default")
    against = type(bundle)(**{**vars(bundle), "metadata": bundle.metadata.model_copy(update={"refine": "off"})})
    assert {one.source for one in answered(stream_of(OneModel(Estimator(against, refine=True))))} == {"network"}


class TwoModels(OneModel):
    """One model serves, another one runs in standby, and they may change places."""

    def __init__(self, serving, standby):
        self.now = Roles(Serving(serving, 0), Serving(standby, 1))

    def roles(self, _):
        return self.now


def test_the_comparison_of_two_models_gets_the_answers_of_the_networks(estimator):
    source = TwoModels(estimator, Estimator(models.find("default"), refine=True))
    stream = stream_of(source)
    found = answered(stream)
    assert "refined" in {one.source for one in found}
    while stream.lanes.has_backlog:
        stream.lanes.run_standby()
    pairs = stream.lanes.comparison.figures().pairs
    assert len(pairs) == len(found)
    for pair in pairs:
        np.testing.assert_allclose(pair.tried, pair.proven, atol=1e-9)


def test_a_new_model_goes_on_with_the_filter_of_the_old_one(estimator):
    def swapped(new):
        source = OneModel(estimator)
        stream = stream_of(source)
        found = []
        for packet in packets(10_000):
            if packet.seq == 18:
                source._roles = Roles(Serving(new, 1))
            found += stream.accept(packet, Arrival(0, 0))
        return found

    same, other = swapped(estimator), swapped(Estimator(models.find("default"), refine=True))
    for one, two in zip(same, other, strict=True):
        np.testing.assert_allclose(one.twist[3:], two.twist[3:], atol=1e-6)
        np.testing.assert_allclose(one.covariance, two.covariance, atol=1e-6)
