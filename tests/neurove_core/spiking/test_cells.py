"""ASLSTM, SLSTM and readout compared with their equations written by hand, and properties of their state."""

import math

import pytest
import torch
from torch import Tensor

from neurove_core.spiking.aslstm import ASLSTM, ASLSTMParams, ASLSTMState, aslstm_step
from neurove_core.spiking.readout import Readout, readout_step
from neurove_core.spiking.slstm import SLSTM, SLSTMParams, SLSTMState, slstm_step
from neurove_protocol.errors import InvalidField

each_form = pytest.mark.parametrize("diffusion", [True, False], ids=["aslstm", "without_diffusion"])
each_width = pytest.mark.parametrize(("inputs", "hidden"), [(1, 8), (8, 8), (5, 3)])


def make_layer(inputs: int = 5, hidden: int = 7, seed: int = 0, **options) -> ASLSTM:
    """A layer whose cells fire in some steps."""
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
def test_one_cell_computes_equations_7_and_9_as_written_by_hand(d, alpha):
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
    assert {s for _, _, s in expected} == {0.0, 1.0}  # it fires in some steps only, so the reset has an effect
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
def test_a_sequence_may_be_split_anywhere_if_the_state_continues(diffusion):
    layer, x = make_layer(diffusion=diffusion), make_input(5)
    _, whole = layer(x, layer.initial_state(4))
    _, middle = layer(x[:5], layer.initial_state(4))
    assert_states_equal(layer(x[5:], middle)[1], whole)


@each_form
@each_width
def test_a_constant_input_changes_the_state_at_every_step_for_any_widths(inputs, hidden, diffusion):
    layer = make_layer(inputs, hidden, diffusion=diffusion)
    states, _ = layer(make_input(inputs, steps=1).expand(8, -1, -1), layer.initial_state(4))
    assert (states.c.diff(dim=0).abs().amax(dim=(1, 2)) > 1e-6).all()  # a cell without memory repeats its first step
    assert (states.v.diff(dim=0).abs().amax(dim=(1, 2)) > 1e-6).all()


@each_form
def test_an_early_input_still_affects_late_steps(diffusion):
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
        assert gradient.reshape(len(gradient), -1).any(dim=1).all(), name  # for every gate and every cell
    assert by_x[0].any()


@pytest.mark.parametrize("v_th", [-1e6, 1e6], ids=["always_fires", "never_fires"])
def test_where_no_spike_changes_the_gradient_is_the_derivative(v_th):
    layer, x = make_layer(3, 2), make_input(3, steps=3, batch=2)
    state = ASLSTMState(*make_input(2, steps=3, batch=2, seed=3))
    state = state._replace(s=torch.full_like(state.s, float(v_th < 0)))
    constants = layer.params()._replace(v_th=v_th)[4:]

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


def test_after_a_spike_no_h_remains_in_the_membrane_at_the_next_step():
    layer, x = make_layer(), make_input(5, steps=1)[0]
    rest = layer.initial_state(4)
    fired = aslstm_step(x, rest._replace(s=torch.ones_like(rest.s)), layer.params())
    torch.testing.assert_close(fired.v, x @ layer.w_x[4 * 7 :].T + layer.b[4 * 7 :])
    assert not torch.allclose(fired.v, aslstm_step(x, rest, layer.params()).v)


def test_without_diffusion_a_layer_equals_one_with_zero_diffusion():
    with_zero, without = make_layer(seed=5), make_layer(seed=5, diffusion=False)
    with torch.no_grad():
        with_zero.d_time.zero_()
    x = make_input(5)
    assert_states_equal(with_zero(x, with_zero.initial_state(4))[1], without(x, without.initial_state(4))[1])
    assert without.state_dict().keys() == {"w_x", "w_v", "b"}


@pytest.mark.parametrize("kappa", [0.0, 0.2, 0.9])
def test_output_neurons_sum_a_constant_input_geometrically(kappa):
    z, weight, bias = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.5, 0.25], [2.0, 0.1]]), torch.tensor([0.3, -0.4])
    drive = torch.tensor([[0.5 - 0.5 + 0.3, 2.0 - 0.2 - 0.4]])
    y = torch.zeros(1, 2)
    for t in range(1, 8):
        y = readout_step(z, y, weight, bias, kappa)
        torch.testing.assert_close(y, drive * (1 - kappa**t) / (1 - kappa))


# SLSTM


def make_slstm(inputs: int = 5, hidden: int = 7, **options) -> SLSTM:
    """A layer whose cells fire in some steps."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SLSTM(inputs, hidden, **options).double()


@pytest.mark.parametrize("v_th", [0.05, 0.2])
def test_one_slstm_cell_computes_its_equations_as_written_by_hand(v_th):
    w = {"i": (0.7, -0.3, 0.1), "f": (-0.4, 0.6, 0.5), "g": (1.1, 0.9, -0.2), "o": (0.3, -0.8, 0.4)}
    params = SLSTMParams(
        w_x=torch.tensor([[w[name][0]] for name in "ifgo"], dtype=torch.float64),
        w_v=torch.tensor([[w[name][1]] for name in "ifgo"], dtype=torch.float64),
        b=torch.tensor([w[name][2] for name in "ifgo"], dtype=torch.float64),
        v_th=v_th,
    )
    zero = torch.zeros(1, 1, dtype=torch.float64)
    state, c, v, s, fired = SLSTMState(zero, zero, zero), 0.0, 0.0, 0.0, set()
    for x in [0.9, -0.4, 1.5, 1.2, -2.0, 0.3, 0.8, 0.0]:
        gate_i, gate_f, gate_g, gate_o = (w[name][0] * x + w[name][1] * v + w[name][2] for name in "ifgo")
        c = sigmoid(gate_f) * c + sigmoid(gate_i) * math.tanh(gate_g)
        v = sigmoid(gate_o) * math.tanh(c) - v_th * s
        s = 1.0 if v >= v_th else 0.0
        fired.add(s)
        state = slstm_step(torch.full((1, 1), x, dtype=torch.float64), state, params)
        assert [field.item() for field in state] == pytest.approx((c, v, s), abs=1e-12)
    assert fired == {0.0, 1.0}


@each_width
@pytest.mark.parametrize("cut", [1, 5, 11])
def test_slstm_steps_equal_its_scan_and_it_may_be_split_anywhere(inputs, hidden, cut):
    layer, x = make_slstm(inputs, hidden), make_input(inputs)
    states, last = layer(x, layer.initial_state(4))
    state = layer.initial_state(4)
    for t, x_t in enumerate(x):
        state = slstm_step(x_t, state, layer.params())
        for one, field in zip(state, states, strict=True):
            assert torch.equal(one, field[t])
    _, middle = layer(x[:cut], layer.initial_state(4))
    for one, other in zip(layer(x[cut:], middle)[1], last, strict=True):
        assert torch.equal(one, other)
    assert 0 < states.s.mean() < 1


@each_width
def test_slstm_keeps_its_memory_under_a_constant_input_for_any_widths(inputs, hidden):
    layer = make_slstm(inputs, hidden, v_th=0.9)  # snnTorch 1.0.0 repeats its first step with 1 input and 8 cells
    states, _ = layer(torch.ones(4, 3, inputs, dtype=torch.float64), layer.initial_state(3))
    for field in (states.c, states.v):
        assert (field.diff(dim=0).abs().amax(dim=(1, 2)) > 1e-4).all()


@pytest.mark.parametrize("s", [0.0, 1.0])
def test_where_no_spike_changes_the_gradient_of_slstm_is_the_derivative(s):
    layer, x = make_slstm(3, 2, v_th=0.99), make_input(3, steps=3, batch=2)
    start = SLSTMState(*make_input(2, steps=3, batch=2, seed=3))._replace(s=torch.full((2, 2), s).double())

    def run(x: Tensor, c: Tensor, v: Tensor, w_x: Tensor, w_v: Tensor, b: Tensor, v_th: Tensor) -> tuple[Tensor, ...]:
        state = start._replace(c=c, v=v)
        for x_t in x:
            state = slstm_step(x_t, state, SLSTMParams(w_x, w_v, b, v_th))
            assert not state.s.any()
        return state.c, state.v

    v_th = torch.full((2,), 0.99, dtype=torch.float64)  # one per neuron
    inputs = [t.detach().clone().requires_grad_() for t in (x, start.c, start.v, *layer.params()[:3], v_th)]
    assert torch.autograd.gradcheck(run, inputs)


def test_no_gradient_goes_through_the_reset_of_slstm():
    layer = make_slstm(3, 2)
    state = SLSTMState(*(t.requires_grad_() for t in make_input(2, steps=3, batch=2, seed=3)))
    after = slstm_step(make_input(3, steps=1, batch=2)[0], state, layer.params())
    by_s, by_v = torch.autograd.grad(after.v.sum(), (state.s, state.v), allow_unused=True)
    assert by_s is None
    assert by_v.any()


# Readout


def test_the_readout_scan_equals_its_steps_and_continues_from_its_state():
    readout, z = Readout(5, 2).double(), make_input(5)
    assert readout.kappa.item() == pytest.approx(0.2)
    answers, last = readout(z, readout.initial_state(4))
    y = readout.initial_state(4)
    for z_t, answer in zip(z, answers, strict=True):
        y = readout_step(z_t, y, readout.f.weight, readout.f.bias, readout.kappa)
        assert torch.equal(y, answer)
    _, middle = readout(z[:5], readout.initial_state(4))
    assert torch.equal(readout(z[5:], middle)[1], last)


@pytest.mark.parametrize("logit", [-30.0, 30.0])
def test_kappa_stays_between_0_and_1_for_any_logit(logit):
    readout = Readout(5, 2).double()
    torch.nn.init.constant_(readout.kappa_logit, logit)
    assert 0 < readout.kappa < 1


def test_the_gradient_of_the_readout_is_the_derivative():
    readout, z = Readout(3, 2).double(), make_input(3, steps=3, batch=2)
    names = [name for name, _ in readout.named_parameters()]
    assert "kappa_logit" in names

    def run(z: Tensor, *parameters: Tensor) -> Tensor:
        values = dict(zip(names, parameters, strict=True))
        answers, _ = torch.func.functional_call(readout, values, (z, readout.initial_state(2)))
        return answers

    assert torch.autograd.gradcheck(run, [t.detach().clone().requires_grad_() for t in (z, *readout.parameters())])


# Errors


@pytest.mark.parametrize(
    ("call", "field", "bound"),
    [
        (lambda: ASLSTM(0, 3), "inputs", "at least 1"),
        (lambda: SLSTM(3, 0), "hidden", "at least 1"),
        (lambda: Readout(3, 0), "outputs", "at least 1"),
        (lambda: ASLSTM(3, 3, alpha=1.5), "alpha", "0 to 1"),
        (lambda: ASLSTM(3, 3, v_th=0.0), "v_th", "above 0"),
        (lambda: SLSTM(3, 3, v_th=-0.1), "v_th", "above 0"),
        (lambda: ASLSTM(3, 3, surrogate="step"), "surrogate", "rectangular, arctan, triangle"),
        (lambda: SLSTM(3, 3, surrogate="step"), "surrogate", "rectangular, arctan, triangle"),
        (lambda: SLSTM(3, 3, surrogate_width=-1.0), "surrogate_width", "above 0"),
        (lambda: Readout(3, 3, kappa=0.0), "kappa", "above 0"),
        (lambda: Readout(3, 3, kappa=1.0), "kappa", "below 1"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_value_and_bound(call, field, bound):
    with pytest.raises(InvalidField, match=bound) as caught:
        call()
    assert caught.value.details["field"] == field


@pytest.mark.parametrize("layer", [make_layer(), make_slstm(), Readout(5, 7).double()], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("shape", [(3, 4, 6), (4, 5), (0, 4, 5)])
def test_a_wrong_input_or_state_is_named_with_its_shape(layer, shape):
    with pytest.raises(InvalidField, match=r"x.shape=.*must be \(T, B, 5\)"):
        layer(torch.zeros(*shape, dtype=torch.float64), layer.initial_state(4))
    with pytest.raises(InvalidField, match=r"state.shape=\(2, 7\): must be \(B, N\) = \(4, 7\)"):
        layer(make_input(5), layer.initial_state(2))


def test_a_step_of_another_width_is_rejected():
    layer = make_slstm()
    with pytest.raises(InvalidField, match="5 wide"):
        slstm_step(torch.zeros(4, 6).double(), layer.initial_state(4), layer.params())
