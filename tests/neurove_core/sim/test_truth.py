"""The truth of a simulation at any time."""

import numpy as np
import pytest

from neurove_core.io.formats.pattern import Pattern
from neurove_core.sim.source import simulation_of
from neurove_core.sim.truth import Truth, truth_of


def test_the_truth_of_a_simulation_is_that_of_its_twists():
    simulation = simulation_of("sim://street?seed=3&seconds=2")
    twists = simulation.twists()
    truth = truth_of(simulation)
    for number in (0, 7, len(twists.t) - 1):
        assert truth.at(int(twists.t[number])) == pytest.approx(twists.twist[number])
    assert truth.at(-1) is None
    assert truth.at(2_000_001) is None


def test_the_truth_of_a_simulation_without_end_is_that_of_its_steps():
    simulation = simulation_of("sim://wall?trajectory=handheld&camera=davis346-half")
    truth = Truth(simulation)
    end_us = int(simulation.trajectory.duration_s * 1e6)
    first = next(simulation.steps())
    assert truth.at(int(first.twists.t[1])) == pytest.approx(first.twists.twist[1])
    after = truth.at(end_us + 1_000_000)
    assert after == pytest.approx(
        simulation.next_trajectory(1).twist(np.array((end_us % 1000 + 1_000_000) / 1e6)), abs=0.02
    )
    assert truth.at(end_us // 2) == pytest.approx(simulation.trajectory.twist(np.array(end_us // 2 / 1e6)))


def test_a_source_that_is_not_simulated_has_no_truth():
    assert truth_of(Pattern()) is None
