"""Firing rates of ALIF, LIF and LTC under the same random currents: the paper's firing-frequency figure, with numbers.

Source: NeuroVE, section IV-B and its figure "Results of neuronal firing frequency". The paper states no current, no
threshold, no leak, no D and no rate. Those used here are constants of this module and appear in every file it writes.

J adds positive drive wherever the diffusing potential is positive on average, which is the case here. ALIF is therefore
expected to fire more than LIF, and a higher rate says nothing about accuracy.
"""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurove_core.experiments import save_text
from neurove_core.figures import blank_figure, save_figure
from neurove_core.spiking.alif import ALIFParams, alif_potential, diffuse
from neurove_core.spiking.layers import require
from neurove_core.spiking.lif import LIF, LIFParams, LIFState, NeuronSteps, fire
from neurove_core.spiking.ltc import LTCParams, LTCState, ltc_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEPS = 1000
SEEDS = 10
V_TH = 1.0
DECAY = 0.5
DIFFUSIONS = (0.1, 0.25, 0.5)
LTC_V_TH = 0.5  # the value of Yin
LTC_NEURONS = 64  # per seed, each with its own random time constant
SHOWN_D = 0.25  # D of ALIF in the figure
SHOWN_STEPS = 200

CURRENTS = {
    "ou": {"mean": 0.34, "sd": 0.28, "rate_per_step": 0.1},
    "normal": {"mean": 0.33, "sd": 0.28},
    "uniform": {"low": 0.0, "high": 1.0},
}
"""Ornstein-Uhlenbeck, normal and uniform currents, dimensionless. The preliminary study does not state its currents.

The first two are chosen so that LIF fires as often as in that study; uniform from 0 to 1 needed no choice.
"""

STUDY: dict[str, dict[str, float]] = {
    "LIF": {"ou": 0.096, "normal": 0.080, "uniform": 0.232},
    "ALIF own v, D = 0.1": {"ou": 0.143, "normal": 0.124, "uniform": 0.300},
    "ALIF own v, D = 0.25": {"ou": 0.243, "normal": 0.222, "uniform": 0.431},
    "ALIF own v, D = 0.5": {"ou": 0.513, "normal": 0.512, "uniform": 0.726},
    "ALIF neighbour v, D = 0.1": {"ou": 0.139},
    "ALIF neighbour v, D = 0.25": {"ou": 0.215},
    "ALIF neighbour v, D = 0.5": {"ou": 0.328},
    "LTC, v_th 0.5": {"ou": 0.103, "normal": 0.087, "uniform": 0.248},
    "LTC, v_th 1": {"ou": 0.003},
    "Eq. (6a) literal, no leak, D = 0": {"ou": 0.257},
}
"""Rates [spikes per step] of the preliminary study, which used other seeds."""


class Rate(NamedTuple):
    """Spikes per neuron and step: mean and standard deviation over the seeds."""

    mean: float
    sd: float


class Results(NamedTuple):
    """The rates of one run."""

    seed: int  # the first of SEEDS seeds
    rates: dict[str, dict[str, Rate]]  # by neuron, then by current


def run(seed: int = 0) -> Results:
    """Measure every neuron under every current, with the seeds `seed` to `seed` + 9.

    Raises:
        InvalidField: a seed below 0.
    """
    require(seed >= 0, "reproduce firing", "seed", seed, "must be at least 0")
    seeds = range(seed, seed + SEEDS)
    current = torch.stack([random_current(kind, one) for kind in CURRENTS for one in seeds], dim=1)
    rates = {}
    for neuron, steps in responses(current, seed).items():
        of_kind = steps.s.mean(dim=(0, 2)).view(len(CURRENTS), SEEDS)
        rates[neuron] = {
            kind: Rate(row.mean().item(), row.std().item()) for kind, row in zip(CURRENTS, of_kind, strict=True)
        }
    return Results(seed, rates)


def random_current(kind: str, seed: int, steps: int = STEPS) -> Tensor:
    """A random current (T,), dimensionless; Ornstein-Uhlenbeck starts at its mean.

    Args:
        kind: a key of CURRENTS.
        seed: of the random numbers.
        steps: T.

    Raises:
        InvalidField: the kind is unknown.
    """
    require(kind in CURRENTS, "reproduce firing", "kind", kind, f"must be one of {', '.join(CURRENTS)}")
    rng, law = np.random.default_rng(seed), CURRENTS[kind]
    if kind == "uniform":
        return torch.from_numpy(rng.uniform(law["low"], law["high"], steps))
    noise = rng.standard_normal(steps)
    if kind == "ou":
        keep = 1 - law["rate_per_step"]
        x = 0.0
        for t, kick in enumerate(noise):
            noise[t] = x = keep * x + math.sqrt(1 - keep * keep) * kick
    return torch.from_numpy(law["mean"] + law["sd"] * noise)


@torch.no_grad()
def responses(current: Tensor, seed: int) -> dict[str, NeuronSteps]:
    """Spikes and potentials (T, B, N) of every neuron, by its name, under B currents.

    Args:
        current: (T, B), one current per run.
        seed: of the random weights of LTC.
    """
    x = current[..., None]
    neighbour = lif(x)
    found = {"LIF": neighbour}
    for d in DIFFUSIONS:
        found[f"ALIF own v, D = {d:g}"] = own_before_reset(x, d)
    for d in DIFFUSIONS:
        found[f"ALIF own v after reset, D = {d:g}"] = alif(x, torch.zeros_like(x), ALIFParams(lif_params(), 0.0, d))
    for d in DIFFUSIONS:
        found[f"ALIF neighbour v, D = {d:g}"] = alif(x, neighbour.v, ALIFParams(lif_params(), d, 0.0))
    for v_th in (LTC_V_TH, V_TH):
        found[f"LTC, v_th {v_th:g}"] = ltc(x, seed, v_th)
    found["Eq. (6a) literal, no leak, D = 0"] = alif(x, torch.zeros_like(x), ALIFParams(lif_params(1.0), 0.0))
    return found


def lif_params(decay: float = DECAY) -> LIFParams:
    """The parameters that LIF and ALIF share, so that they differ only in D."""
    return LIFParams(decay, V_TH)


def lif(x: Tensor) -> NeuronSteps:
    """LIF neurons, one per current (T, B, 1)."""
    neurons = LIF(1, decay=DECAY, v_th=V_TH).double()
    steps, _ = neurons(x, neurons.initial_state(x.shape[1]))
    return NeuronSteps(*steps)


def alif(x: Tensor, v_before: Tensor, params: ALIFParams) -> NeuronSteps:
    """ALIF neurons as `alif_step` with f the identity, for currents and neighbour potentials (T, B, 1)."""
    state, steps = LIFState(torch.zeros_like(x[0])), []
    for current, neighbour in zip(x, v_before, strict=True):
        v = alif_potential(diffuse(current, neighbour, params.d_space), state, params)
        s, state = fire(v, params.lif)
        steps.append((s, v))
    return stacked(steps)


def own_before_reset(x: Tensor, d: float) -> NeuronSteps:
    """ALIF neurons whose own potential before the reset diffuses to the next step, as in Eq. (9) of ASLSTM.

    A neuron that fired keeps D v in spite of the reset. This reading therefore has the highest rate.
    """
    params = lif_params()
    state, v, steps = LIFState(torch.zeros_like(x[0])), torch.zeros_like(x[0]), []
    for current in x:
        v = params.decay * state.v + current + d * v
        s, state = fire(v, params)
        steps.append((s, v))
    return stacked(steps)


def ltc(x: Tensor, seed: int, v_th: float) -> NeuronSteps:
    """LTC neurons without synapses: d is the current itself, and the weights of the time constant are random.

    The N = LTC_NEURONS neurons are independent: W_a [d, m] of each has one weight for d and one for m, drawn from
    U(-1, 1)/sqrt(2), and no bias.

    Args:
        x: currents (T, B, 1).
        seed: of the random weights.
        v_th: threshold.

    Returns:
        spikes and potentials after the reset (T, B, N).
    """
    rng, n = np.random.default_rng([seed, 1]), LTC_NEURONS
    w_d, w_m = (torch.from_numpy(rng.uniform(-1, 1, n) / math.sqrt(2)) for _ in range(2))
    zeros = torch.zeros(n, dtype=torch.float64)
    params = LTCParams(
        w_x=torch.ones(n, 1, dtype=torch.float64),
        w_s=torch.zeros(n, n, dtype=torch.float64),
        b=zeros,
        w_a=torch.cat((torch.diag(w_d), torch.diag(w_m)), dim=1),
        b_a=zeros,
        v_th=v_th,
    )
    state, steps = LTCState(*(zeros.expand(x.shape[1], n) for _ in range(2))), []
    for current in x:
        state = ltc_step(current, state, params)
        steps.append((state.s, state.m))
    return stacked(steps)


def stacked(steps: list[tuple[Tensor, Tensor]]) -> NeuronSteps:
    """Stack the spikes and potentials of single steps into sequences."""
    spikes, potentials = zip(*steps, strict=True)
    return NeuronSteps(torch.stack(spikes), torch.stack(potentials))


def to_json(results: Results) -> str:
    """The results as JSON: the set-up, the rates, and the rates of the preliminary study."""
    about = {
        "command": f"neurove reproduce firing --seed {results.seed}",
        "seeds": [results.seed, results.seed + SEEDS - 1],
        "steps": STEPS,
        "v_th": V_TH,
        "decay": DECAY,
        "currents": CURRENTS,
        "rates": {
            neuron: {kind: rate._asdict() for kind, rate in by_kind.items()}
            for neuron, by_kind in results.rates.items()
        },
        "study": STUDY,
    }
    return json.dumps(about, indent=2) + "\n"


def to_markdown(results: Results) -> str:
    """The rates as a Markdown table: mean, standard deviation, and the rate of the preliminary study in brackets."""
    lines = [
        f"Spikes per step: mean ± standard deviation over {SEEDS} seeds ({results.seed} to {results.seed + SEEDS - 1}) "
        f"of {STEPS} steps; in brackets those of the preliminary study. LIF and ALIF: v_th {V_TH:g}, leak {DECAY:g}.",
        "",
        f"| neuron | {' | '.join(CURRENTS)} |",
        f"| --- | {' | '.join('---' for _ in CURRENTS)} |",
    ]
    for neuron, by_kind in results.rates.items():
        cells = (cell(rate, STUDY.get(neuron, {}).get(kind)) for kind, rate in by_kind.items())
        lines.append(f"| {neuron} | {' | '.join(cells)} |")
    lines += [
        "",
        "ALIF own v: D v(t-1) of the same neuron before its reset, as (9) in ASLSTM; after reset: as `alif_step`;",
        "neighbour v: D V_i of a LIF neuron under the same current, before its reset. The literal, leakless Eq. (6a)",
        "equals own v after reset at D = 0.5, because 0.5 + 0.5 = 1.",
        "",
        "J adds positive drive, so ALIF is expected to fire more than LIF. LTC at its own threshold of 0.5 fires about",
        "as often as LIF, because its potential averages the current, while that of LIF sums it up to twice as high.",
    ]
    return "\n".join(lines) + "\n"


def cell(rate: Rate, study: float | None) -> str:
    """One cell of the table."""
    return f"{rate.mean:.3f} ± {rate.sd:.3f}" + ("" if study is None else f" ({study:.3f})")


def save(results: Results, out: Path) -> list[Path]:
    """Write firing.json, firing.md, firing.png and firing.svg into a folder and return their paths.

    Raises:
        MissingExtra: matplotlib is not installed, and nothing is written.
        InvalidField: a file cannot be written.
    """
    figure = draw(results.seed)
    return [
        save_text(to_json(results), out / "firing.json"),
        save_text(to_markdown(results), out / "firing.md"),
        *save_figure(figure, out / "firing"),
    ]


@torch.no_grad()
def draw(seed: int) -> "Figure":
    """The paper's figure: one random current and the responses of ALIF, LIF and LTC, for the first SHOWN_STEPS steps.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    figure = blank_figure(7.0, 6.5)
    current = random_current("ou", seed)
    x = current[:, None, None]
    top, *rows = figure.subplots(4, 1, sharex=True)
    top.plot(current[:SHOWN_STEPS], color="0.3", linewidth=1)
    top.set_title("Random current (Ornstein-Uhlenbeck)", fontsize=9, loc="left")
    top.set_ylabel("current")
    shown = (
        (f"ALIF (D = {SHOWN_D:g} of its own v)", own_before_reset(x, SHOWN_D), V_TH, "tab:red"),
        ("LIF", lif(x), V_TH, "tab:blue"),
        ("LTC (first neuron)", ltc(x, seed, LTC_V_TH), LTC_V_TH, "tab:green"),
    )
    for axis, (title, steps, v_th, color) in zip(rows, shown, strict=True):
        s, v = steps.s[:, 0, 0], steps.v[:, 0, 0]
        rate = s.mean().item()
        axis.plot((v * (1 - s))[:SHOWN_STEPS], color=color, linewidth=1)  # after the reset
        axis.axhline(v_th, color="0.6", linewidth=0.8, linestyle=":")
        axis.vlines(s[:SHOWN_STEPS].nonzero().flatten(), 1.05 * v_th, 1.3 * v_th, color="black", linewidth=1)
        axis.set_title(f"{title}: v_th {v_th:g}, {rate:.3f} spikes per step over {STEPS} steps", fontsize=9, loc="left")
        axis.set_ylabel("v, spikes")
    rows[-1].set_xlabel("step")
    return figure
