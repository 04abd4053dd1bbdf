"""ASLSTM against the paper's equations written out by hand, and the laws of its state."""

import math

import pytest
import torch
from torch import Tensor

from neurove_core.cells import ASLSTM, ASLSTMParams, ASLSTMState, aslstm_step, readout_step

each_form = pytest.mark.parametrize("diffusion", [True, False], ids=["aslstm", "without_diffusion"])
each_width = pytest.mark.parametrize(("inputs", "hidden"), [(1, 8), (8, 8), (5, 3)])


def make_layer(inputs: int = 5, hidden: int = 7, seed: int = 0, **options) -> ASLSTM:
    """A layer whose cells fire now and then."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return ASLSTM(inputs, hidden, **{"v_th": 0.3, **options}).double()


def make_input(inputs: int, steps: int = 12, batch: int = 4, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(steps, batch, inputs, generator=generator, dtype=torch.float64)


def assert_states_equal(got: ASLSTMState, want: ASLSTMState) -> None:
    for one, other in zip(got, want, strict=True):
        assert torch.equal(one, other)


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def one_unit_by_hand(
    xs: list[float], w: dict[str, tuple[float, float, float]], d: float, alpha: float, v_th: float
) -> list[tuple[float, float, float]]:
    """Eq. (7) and (9) for one cell in plain floats: w names (W, U, bias) of each gate, and (W, -, bias) of f(.)."""
    c = v = s = 0.0
    steps = []
    for x in xs:
        gate_i, gate_f, gate_g, gate_o = (w[name][0] * x + w[name][1] * v + w[name][2] for name in "ifgo")
        c = sigmoid(gate_f) * c + sigmoid(gate_i) * math.tanh(gate_g)
        h = sigmoid(gate_o) * math.tanh(c)
        v = alpha * (1 - s) * h + (w["z"][0] * x + w["z"][2]) + d * v
        s = 1.0 if v >= v_th else 0.0
        steps.append((c, v, s))
    return steps


@pytest.mark.parametrize("d", [0.0, 0.2, 0.7])
@pytest.mark.parametrize("alpha", [0.5, 0.9])
def test_one_cell_computes_equations_7_and_9_as_written_out_by_hand(d, alpha):
    w = {"i": (0.7, -0.3, 0.1), "f": (-0.4, 0.6, 0.5), "g": (1.1, 0.9, -0.2), "o": (0.3, -0.8, 0.4), "z": (0.5, 0, 0.1)}
    xs = [0.9, -0.4, 1.5, 1.2, -2.0, 0.3, 0.8, 0.0]
    params = ASLSTMParams(
        w_x=torch.tensor([[w[name][0]] for name in "ifgoz"], dtype=torch.float64),
        w_v=torch.tensor([[w[name][1]] for name in "ifgo"], dtype=torch.float64),
        b=torch.tensor([w[name][2] for name in "ifgoz"], dtype=torch.float64),
        d_time=torch.tensor([d], dtype=torch.float64),
        alpha=alpha,
        v_th=0.6,
    )
    expected = one_unit_by_hand(xs, w, d, alpha, 0.6)
    assert {s for _, _, s in expected} == {0.0, 1.0}  # it fires, and not always: the reset matters
    zero = torch.zeros(1, 1, dtype=torch.float64)
    state = ASLSTMState(zero, zero, zero)
    for x, by_hand in zip(xs, expected, strict=True):
        state = aslstm_step(torch.tensor([[x]], dtype=torch.float64), state, params)
        assert [field.item() for field in state] == pytest.approx(by_hand, abs=1e-12)


@each_form
@each_width
def test_step_by_step_equals_the_whole_sequence_bit_for_bit(inputs, hidden, diffusion):
    layer, x = make_layer(inputs, hidden, diffusion=diffusion), make_input(inputs)
    states, last = layer(x, layer.initial_state(4))
    state = layer.initial_state(4)
    for t, x_t in enumerate(x):
        state = aslstm_step(x_t, state, layer.params())
        assert_states_equal(state, ASLSTMState(*(field[t] for field in states)))
    assert_states_equal(state, last)
    assert 0 < states.s.mean() < 1


@each_form
def test_a_sequence_may_be_cut_anywhere_if_the_state_goes_on(diffusion):
    layer, x = make_layer(diffusion=diffusion), make_input(5)
    _, whole = layer(x, layer.initial_state(4))
    _, middle = layer(x[:5], layer.initial_state(4))
    assert_states_equal(layer(x[5:], middle)[1], whole)


@each_form
@each_width
def test_a_constant_input_moves_the_state_at_every_step_whatever_the_widths(inputs, hidden, diffusion):
    layer = make_layer(inputs, hidden, diffusion=diffusion)
    states, _ = layer(make_input(inputs, steps=1).expand(8, -1, -1), layer.initial_state(4))
    assert (states.c.diff(dim=0).abs().amax(dim=(1, 2)) > 1e-6).all()  # a cell that forgets repeats its first step
    assert (states.v.diff(dim=0).abs().amax(dim=(1, 2)) > 1e-6).all()


@each_form
def test_what_was_seen_long_ago_still_shows(diffusion):
    layer, x = make_layer(diffusion=diffusion), make_input(5, steps=6)
    other = x.clone()
    other[0] += 1
    (_, one), (_, two) = (layer(seen, layer.initial_state(4)) for seen in (x, other))
    assert (one.c - two.c).abs().max() > 1e-4


@each_form
def test_rows_of_a_batch_do_not_influence_each_other(diffusion):
    layer, x = make_layer(diffusion=diffusion), make_input(5)
    together, _ = layer(x, layer.initial_state(4))
    for row in range(4):
        disturbed = 10 * make_input(5, seed=2)
        disturbed[:, row] = x[:, row]
        alone, _ = layer(disturbed, layer.initial_state(4))
        assert_states_equal(ASLSTMState(*(f[:, row] for f in alone)), ASLSTMState(*(f[:, row] for f in together)))


@each_form
def test_gradients_flow_to_every_parameter_and_back_to_the_first_input(diffusion):
    layer, x = make_layer(diffusion=diffusion), make_input(5).requires_grad_()
    states, _ = layer(x, layer.initial_state(4))
    names, parameters = zip(*layer.named_parameters(), strict=True)
    assert set(names) == {"w_x", "w_v", "b"} | ({"d_time"} if diffusion else set())
    by_x, *gradients = torch.autograd.grad((states.s[-1] + states.v[-1]).sum(), [x, *parameters])
    for name, gradient in zip(names, gradients, strict=True):
        assert torch.isfinite(gradient).all(), name
        assert gradient.reshape(len(gradient), -1).any(dim=1).all(), name  # of every gate and every cell
    assert by_x[0].any()


@pytest.mark.parametrize("v_th", [-1e6, 1e6], ids=["always_fires", "never_fires"])
def test_where_no_spike_changes_the_gradient_is_the_derivative(v_th):
    layer, x = make_layer(3, 2, v_th=v_th), make_input(3, steps=3, batch=2)
    state = ASLSTMState(*make_input(2, steps=3, batch=2, seed=3))
    state = state._replace(s=torch.full_like(state.s, float(v_th < 0)))
    constants = layer.params()[4:]

    def run(x: Tensor, c: Tensor, v: Tensor, w_x: Tensor, w_v: Tensor, b: Tensor, d_time: Tensor) -> tuple[Tensor, ...]:
        params, now = ASLSTMParams(w_x, w_v, b, d_time, *constants), state._replace(c=c, v=v)
        for x_t in x:
            now = aslstm_step(x_t, now, params)
        return now.c, now.v

    inputs = [t.detach().clone().requires_grad_() for t in (x, state.c, state.v, *layer.params()[:4])]
    assert torch.autograd.gradcheck(run, inputs)


def test_no_gradient_goes_through_the_reset():
    layer = make_layer(3, 2)
    state = ASLSTMState(*(t.requires_grad_() for t in make_input(2, steps=3, batch=2, seed=3)))
    after = aslstm_step(make_input(3, steps=1, batch=2)[0], state, layer.params())
    by_c, by_v, by_s = torch.autograd.grad(after.v.sum(), state, allow_unused=True)
    assert by_s is None
    assert by_c.any()
    assert by_v.any()


def test_a_cell_that_fired_keeps_nothing_of_h_in_its_membrane_at_the_next_step():
    layer, x = make_layer(), make_input(5, steps=1)[0]
    rest = layer.initial_state(4)
    fired = aslstm_step(x, rest._replace(s=torch.ones_like(rest.s)), layer.params())
    torch.testing.assert_close(fired.v, x @ layer.w_x[4 * 7 :].T + layer.b[4 * 7 :])
    assert not torch.allclose(fired.v, aslstm_step(x, rest, layer.params()).v)


def test_the_form_without_diffusion_is_the_layer_with_a_diffusion_of_zero():
    with_zero, without = make_layer(seed=5), make_layer(seed=5, diffusion=False)
    with torch.no_grad():
        with_zero.d_time.zero_()
    x = make_input(5)
    assert_states_equal(with_zero(x, with_zero.initial_state(4))[1], without(x, without.initial_state(4))[1])
    assert without.state_dict().keys() == {"w_x", "w_v", "b"}


@pytest.mark.parametrize("kappa", [0.0, 0.2, 0.9])
def test_output_neurons_driven_by_a_constant_sum_it_up_geometrically(kappa):
    z, weight, bias = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.5, 0.25], [2.0, 0.1]]), torch.tensor([0.3, -0.4])
    drive = torch.tensor([[0.5 - 0.5 + 0.3, 2.0 - 0.2 - 0.4]])
    y = torch.zeros(1, 2)
    for t in range(1, 8):
        y = readout_step(z, y, weight, bias, kappa)
        torch.testing.assert_close(y, drive * (1 - kappa**t) / (1 - kappa))
