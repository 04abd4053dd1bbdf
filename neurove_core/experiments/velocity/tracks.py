"""Estimates of a model on a scenario with the ground truth, and figures from them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core.engine.engine import Engine
from neurove_core.evaluation.metrics import SKIP_S, figures
from neurove_core.experiments.velocity.held_out import Scenario
from neurove_core.ingest.channels import network_input
from neurove_core.models.bundle import PER_HEIGHT, Bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import fired
from neurove_core.networks.neurove import NeuroVE
from neurove_core.training.data import Sequences

Array = NDArray[np.float64]

MIN_RATE_DEG_S: Final = 1.0
"""Gehrig 2020 computes relative errors only for true rates above this."""

_CHUNK: Final = 16  # windows per call of the network

_FIGURES: Final = (
    "windows",
    "r2_v_l",
    "r2_v_a",
    "re_v_l",
    "re_v_a",
    "re_v_l_unfloored",
    "re_v_a_unfloored",
    "rmse_v_l_m_s",
    "rmse_v_a_rad_s",
    "rmse_v_a_deg_s",
    "median_direction_error_v_l_deg",
)  # of metrics.figures


class Track(NamedTuple):
    """Estimates and ground truth of one scenario, bin by bin, without the first SKIP_S."""

    group: str
    name: str
    t_s: Array  # (N,) middle of each bin
    truth: Array  # (N, 6) [m/s, rad/s]
    estimate: Array  # (N, 6)
    bins: int


@torch.inference_mode()
def follow(model: Bundle, path: Path, scenario: Scenario) -> tuple[Track, tuple[int, int]]:
    """Run a model over the windows of a scenario from the zero state, as the service would.

    Args:
        model: of any kind.
        path: the sequence file of the scenario.
        scenario: the simulated scenario.

    Returns:
        its track, and the numbers of spikes and of neurons, summed over the states after every 16 windows.
    """
    found = Sequences([path])
    twists, height_m = found.twists[0].astype(np.float64), found.height_m[0]
    network = model.network.eval()
    step: Callable[..., Any] = Engine(network) if isinstance(network, NeuroVE) else network
    state, answers, counted = network.initial_state(1), [], np.zeros(2, np.int64)
    seen = torch.from_numpy(network_input(found.counts(0, 0, len(twists)).copy(), model.config))[:, None]
    for counts in torch.split(seen, _CHUNK):
        answer, state = step(to_spikes(counts.contiguous(), model.config.network.encoding), state)
        answers.append(answer[:, 0])
        for layer in fired(state).values():
            counted += [int(layer.sum()), layer.numel()]
    answer = (torch.cat(answers) * model.scale + model.offset).double().numpy()
    metres = np.array([height_m] * 3 + [1.0] * 3)
    bins, window_s = twists.shape[1], model.config.window.duration_us / 1e6
    kept = slice(round(SKIP_S / window_s), None)
    t_s = (np.arange(twists.shape[0] * bins).reshape(-1, bins) + 0.5) * window_s / bins
    truth = (twists * metres)[kept].reshape(-1, 6)
    estimate = (answer * (metres if model.linear_unit == PER_HEIGHT else 1.0))[kept].reshape(-1, 6)
    return Track(scenario.group, scenario.name, t_s[kept].ravel(), truth, estimate, bins), (
        int(counted[0]),
        int(counted[1]),
    )


def summaries(tracks: list[Track]) -> dict[str, dict[str, Any]]:
    """The figures of each group, over all its scenarios together."""
    groups = dict.fromkeys(track.group for track in tracks)
    return {group: summary([track for track in tracks if track.group == group]) for group in groups}


def summary(tracks: list[Track]) -> dict[str, Any]:
    """The figures for the tables, over some tracks together.

    `gehrig_*` are the two figures of Gehrig 2020. One is the mean length of the angular error, which that paper calls
    RMSE. The other is the median ratio of that length to the true rate, for true rates above MIN_RATE_DEG_S.
    """
    truth, estimate = (
        np.concatenate(parts) for parts in zip(*((one.truth, one.estimate) for one in tracks), strict=True)
    )
    all_figures = figures(truth, estimate, tracks[0].bins)
    error, rate = (np.degrees(np.linalg.norm(part[:, 3:], axis=1)) for part in (estimate - truth, truth))
    counted = rate > MIN_RATE_DEG_S
    return {name: all_figures[name] for name in _FIGURES} | {
        "rmse_yaw_deg_s": all_figures["per_axis"]["wy"]["rmse_deg_s"],
        "spread_v_l_m_s": all_figures["spread_v_l_m_s"],
        "spread_v_a_deg_s": all_figures["spread_v_a_deg_s"],
        "gehrig_mean_error_deg_s": float(error.mean()),
        "gehrig_median_re": float(np.median(error[counted] / rate[counted])) if counted.any() else None,
    }


def blind_predictors(tracks: list[Track]) -> dict[str, dict[str, dict[str, Any]]]:
    """The figures by group of two predictors that ignore the events: `zero`, and the `mean` truth of the group."""
    groups = {group: [one for one in tracks if one.group == group] for group in dict.fromkeys(t.group for t in tracks)}
    means = {group: np.concatenate([one.truth for one in own]).mean(axis=0) for group, own in groups.items()}
    estimate: dict[str, dict[str, Array]] = {"zero": {group: np.zeros(6) for group in groups}, "mean": means}
    return {
        name: {
            group: summary([one._replace(estimate=np.broadcast_to(values[group], one.truth.shape)) for one in own])
            for group, own in groups.items()
        }
        for name, values in estimate.items()
    }
