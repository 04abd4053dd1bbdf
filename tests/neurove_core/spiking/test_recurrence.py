"""The compiled network equals the plain layers in outputs, spikes and gradients, in open and closed loop."""

import numpy as np
import pytest
import torch

from neurove_core.spiking.alif import diffuse
from neurove_core.spiking.aslstm import ASLSTMParams, ASLSTMState, aslstm_step
from neurove_core.spiking.fused import recurrence
from neurove_core.spiking.fused.recurrence import (
    ASLSTM,
    LTC,
    SLSTM,
    Constants,
    LayerState,
    LayerWeights,
    State,
    Weights,
)
from neurove_core.spiking.ltc import LTCParams, LTCState, ltc_step
from neurove_core.spiking.readout import readout_step
from neurove_core.spiking.slstm import SLSTMParams, SLSTMState, slstm_step

pytestmark = pytest.mark.xdist_group("recurrence")  # one process compiles the kernels for all of them

STEPS, BATCH, HIDDEN = 40, 5, 7
CONSTANTS = Constants(alpha=0.5, width=0.5, damping=0.25)
GRAD_S = (0.02, -0.03)  # gradient of the loss with respect to each spike of a layer


def make_weights(kind, dtype=np.float64, seed=0):
    draw = np.random.default_rng(seed)
    gates = {ASLSTM: 5, SLSTM: 4, LTC: 1}[kind] * HIDDEN
    ltc = kind == LTC

    def uniform(*shape):
        return draw.uniform(-(HIDDEN**-0.5), HIDDEN**-0.5, shape).astype(dtype)

    def layer(inputs):
        return LayerWeights(
            w_x=uniform(inputs, gates),
            w_r=uniform(HIDDEN, HIDDEN if ltc else 4 * HIDDEN),
            b=uniform(gates),
            d_time=uniform(HIDDEN) if kind == ASLSTM else uniform(0),
            w_a=uniform(2 * HIDDEN, HIDDEN) if ltc else uniform(0, 0),
            b_a=uniform(HIDDEN) if ltc else uniform(0),
            d_space=uniform(HIDDEN),
            v_th=np.abs(uniform(HIDDEN)),
            s_weight=np.ones(1, dtype),
        )

    return Weights(layer(1), layer(HIDDEN), uniform(HIDDEN), uniform(1), np.array([0.2], dtype))


def make_state(dtype=np.float64):
    draw = np.random.default_rng(1)

    def layer():
        c, v = (draw.normal(size=(BATCH, HIDDEN)).astype(dtype) * 0.3 for _ in range(2))
        return LayerState(c, v, (draw.random((BATCH, HIDDEN)) < 0.3).astype(dtype))

    return State(layer(), layer(), draw.normal(size=BATCH).astype(dtype))


def make_inputs(dtype=np.float64):
    return np.random.default_rng(2).normal(size=(STEPS, BATCH)).astype(dtype)


class Plain:
    """The same network from the plain steps of the cells, one tensor per weight."""

    def __init__(self, kind, weights):
        self.kind = kind
        self.first, self.second = (LayerWeights(*(self._leaf(array) for array in layer)) for layer in weights[:2])
        self.w_out, self.b_out, self.kappa = (self._leaf(array) for array in weights[2:])

    @staticmethod
    def _leaf(array):
        return torch.tensor(array, requires_grad=True)

    def leaves(self):
        return [*self.first, *self.second, self.w_out, self.b_out, self.kappa]

    def layer(self, w, u, state):
        surrogate = ("rectangular", CONSTANTS.width)
        if self.kind == LTC:
            params = LTCParams(w.w_x.T, w.w_r.T, w.b, w.w_a.T, w.b_a, w.v_th, *surrogate)
            after = ltc_step(u, LTCState(state[1], state[2]), params)
            state = (state[0], after.m, after.s)
        elif self.kind == ASLSTM:
            params = ASLSTMParams(w.w_x.T, w.w_r.T, w.b, w.d_time, CONSTANTS.alpha, w.v_th, *surrogate)
            state = aslstm_step(u, ASLSTMState(*state), params)
        else:
            state = slstm_step(u, SLSTMState(*state), SLSTMParams(w.w_x.T, w.w_r.T, w.b, w.v_th, *surrogate))
        s = CONSTANTS.damping * state[2] + (1 - CONSTANTS.damping) * state[2].detach()
        return (state[0], state[1], s), diffuse(w.s_weight * s, state[1], w.d_space)

    def run(self, x, state, free_from):
        one, two = (tuple(torch.tensor(array) for array in layer) for layer in state[:2])
        y = torch.tensor(state.y)
        answers, spikes = [], []
        for t, x_t in enumerate(torch.tensor(x)):
            one, z = self.layer(self.first, (x_t if t < free_from else y)[:, None], one)
            two, z = self.layer(self.second, z, two)
            y = readout_step(z, y[:, None], self.w_out[None], self.b_out, self.kappa)[:, 0]
            answers.append(y)
            spikes.append(torch.stack([one[2], two[2]]))
        return torch.stack(answers), torch.stack(spikes)


@pytest.fixture(params=[ASLSTM, SLSTM, LTC], ids=["aslstm", "slstm", "ltc"])
def kind(request):
    return request.param


@pytest.mark.parametrize("free_from", [STEPS, 25, 1], ids=["teacher-forced", "closed-from-25", "closed"])
def test_outputs_and_gradients_equal_autograd_and_spikes_are_equal_bit_for_bit(kind, free_from):
    weights, state, x = make_weights(kind), make_state(), make_inputs()
    plain = Plain(kind, weights)
    answers, spikes = plain.run(x, state, free_from)
    tape = recurrence.forward(kind, weights, CONSTANTS, x, state, free_from)
    np.testing.assert_allclose(tape.y[1:], answers.detach().numpy(), rtol=0, atol=1e-12)
    fired = np.stack([tape.first.s[1:], tape.second.s[1:]], axis=1)
    assert np.array_equal(fired, spikes.detach().numpy())
    assert 0.01 < fired.mean() < 0.99  # the comparison covers spikes and silence
    grad_y = np.random.default_rng(3).normal(size=answers.shape)
    of_spikes = (spikes.sum(dim=(0, 2, 3)) * torch.tensor(GRAD_S, dtype=answers.dtype)).sum()
    ((answers * torch.tensor(grad_y)).sum() + of_spikes).backward()
    grads = recurrence.backward(kind, weights, CONSTANTS, tape, grad_y, free_from, GRAD_S)
    fields = [f"{layer}.{name}" for layer in ("first", "second") for name in LayerWeights._fields]
    ours = [*grads.first, *grads.second, *grads[2:]]
    for name, own, leaf in zip([*fields, "w_out", "b_out", "kappa"], ours, plain.leaves(), strict=True):
        if own.size and not name.endswith("s_weight"):
            wanted = leaf.grad.numpy()
            assert np.abs(own - wanted).max() <= 1e-9 * np.abs(wanted).max(), name


def test_float32_fires_as_plain_torch_does(kind):
    weights, state, x = make_weights(kind, np.float32), make_state(np.float32), make_inputs(np.float32)
    answers, spikes = Plain(kind, weights).run(x, state, STEPS)
    tape = recurrence.forward(kind, weights, CONSTANTS, x, state, STEPS)
    assert np.array_equal(np.stack([tape.first.s[1:], tape.second.s[1:]], axis=1), spikes.detach().numpy())
    np.testing.assert_allclose(tape.y[1:], answers.detach().numpy(), rtol=0, atol=2e-5)


def test_a_split_sequence_equals_the_whole(kind):
    weights, state, x = make_weights(kind), make_state(), make_inputs()
    whole = recurrence.forward(kind, weights, CONSTANTS, x, state, STEPS)
    first = recurrence.forward(kind, weights, CONSTANTS, x[:17], state, 17)
    rest = recurrence.forward(kind, weights, CONSTANTS, x[17:], recurrence.state_after(first, 17), STEPS)
    np.testing.assert_allclose(np.concatenate([first.y[1:], rest.y[1:]]), whole.y[1:], rtol=0, atol=1e-14)


def test_saturated_inputs_stay_finite_in_float32(kind):
    weights = make_weights(kind, np.float32)
    x = np.array([[1e4] * BATCH, [-1e4] * BATCH] * 5, np.float32)
    tape = recurrence.forward(kind, weights, CONSTANTS, x, make_state(np.float32), len(x))
    assert np.isfinite(tape.y).all()
