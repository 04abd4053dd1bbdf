"""LIF, ALIF and LTC compared with their closed forms; their modules compared with their steps."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neurove_core.spiking import alif, ltc
from neurove_core.spiking import lif as neurons
from neurove_core.spiking.alif import ALIFParams, alif_step, diffuse
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan, lif_step
from neurove_core.spiking.ltc import LTCParams, LTCState, ltc_step
from neurove_core.spiking.surrogate import surrogate_gradient
from neurove_protocol.errors import InvalidField

LIF = LIFParams(decay=0.9, v_th=1.0)


def at_rest(*shape: int) -> LIFState:
    return LIFState(torch.zeros(*shape, dtype=torch.float64))


def random_currents(seed: int, steps: int = 50, low: float = -0.5, high: float = 1.5) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(steps, 3, 4, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.9])
def test_a_silent_population_leaks_geometrically(decay):
    state = LIFState(torch.full((1, 4), 0.8, dtype=torch.float64))
    for _ in range(10):
        spikes, state = lif_step(torch.zeros(1, 4, dtype=torch.float64), state, LIFParams(decay=decay))
        assert not spikes.any()
    torch.testing.assert_close(state.v, torch.full((1, 4), 0.8 * decay**10, dtype=torch.float64))


@given(current=st.floats(0.11, 2.0), decay=st.floats(0.0, 0.95))
def test_a_constant_current_fires_first_when_its_geometric_sum_reaches_the_threshold(current, decay):
    steps = 60
    spikes, _ = lif_scan(torch.full((steps, 1), current, dtype=torch.float64), at_rest(1), LIFParams(decay=decay))
    v = current * (1 - decay ** torch.arange(1, steps + 1, dtype=torch.float64)) / (1 - decay)
    if (v - 1).abs().min() < 1e-9:
        return  # too near the threshold: sum and recursion may round differently
    fired = (v >= 1).nonzero()
    if not len(fired):
        assert not spikes.any()
        return
    period = int(fired[0]) + 1
    assert spikes.flatten().nonzero().flatten().tolist() == list(range(period - 1, steps, period))


@pytest.mark.parametrize("overshoot", [0.0, 0.3, 100.0])
def test_a_neuron_that_fires_is_reset_to_zero_from_any_potential(overshoot):
    current = torch.tensor([[1 + overshoot, 0.999]], dtype=torch.float64)
    spikes, state = lif_step(current, at_rest(1, 2), LIF)
    assert spikes.tolist() == [[1.0, 0.0]]
    assert state.v.tolist() == [[0.0, 0.999]]


@given(v_th=st.floats(0.1, 5.0), seed=st.integers(0, 1_000))
def test_the_threshold_is_the_unit_of_all_potentials(v_th, seed):
    currents = random_currents(seed)
    unit, state = lif_scan(currents, at_rest(3, 4), LIFParams(decay=0.5, v_th=1.0))
    scaled, scaled_state = lif_scan(v_th * currents, at_rest(3, 4), LIFParams(decay=0.5, v_th=v_th))
    assert torch.equal(scaled, unit)
    torch.testing.assert_close(scaled_state.v, v_th * state.v)


@pytest.mark.parametrize("seed", range(5))
def test_a_scan_equals_its_steps_and_may_be_split_anywhere(seed):
    currents = random_currents(seed)
    whole, last = lif_scan(currents, at_rest(3, 4), LIF)
    state, steps = at_rest(3, 4), []
    for current in currents:
        spikes, state = lif_step(current, state, LIF)
        steps.append(spikes)
    first, middle = lif_scan(currents[:17], at_rest(3, 4), LIF)
    second, end = lif_scan(currents[17:], middle, LIF)
    assert 0 < whole.mean() < 1
    assert torch.equal(torch.stack(steps), whole)
    assert torch.equal(torch.cat((first, second)), whole)
    assert torch.equal(state.v, last.v)
    assert torch.equal(end.v, last.v)


def test_the_gradient_flows_through_leak_and_surrogate_but_not_through_the_reset():
    current = torch.tensor([0.2, 0.9, 1.2], dtype=torch.float64, requires_grad=True)
    spikes, state = lif_step(current, at_rest(3), LIF)
    (by_state,) = torch.autograd.grad(state.v.sum(), current, retain_graph=True)
    (by_spikes,) = torch.autograd.grad(spikes.sum(), current)
    assert by_state.tolist() == [
        1.0,
        1.0,
        0.0,
    ]  # 1 where the neuron did not fire, 0 where it did; nothing from the spike
    torch.testing.assert_close(by_spikes, surrogate_gradient(current.detach() - LIF.v_th, "rectangular", 1.0))


def run_alif(spikes: Tensor, v: Tensor, params: ALIFParams) -> Tensor:
    """Spikes of a population that follows another one, f the identity."""
    state, out = at_rest(*spikes.shape[1:]), []
    for x, v_before in zip(spikes, v, strict=True):
        fired, state = alif_step(x, v_before, state, params, lambda z: 0.4 * z)
        out.append(fired)
    return torch.stack(out)


@pytest.mark.parametrize("seed", range(5))
def test_alif_without_diffusion_is_lif(seed):
    spikes, v = random_currents(seed).round().clamp(0, 1), random_currents(seed + 100)
    alif = run_alif(spikes, v, ALIFParams(LIF, d_space=0.0, d_time=0.0))
    lif, _ = lif_scan(0.4 * spikes, at_rest(3, 4), LIF)
    assert lif.any()
    assert torch.equal(alif, lif)


@given(seed=st.integers(0, 10_000), d_space=st.floats(0.0, 1.0), d_time=st.floats(0.0, 0.5))
def test_diffusion_of_positive_potentials_never_makes_a_neuron_fire_later_or_less(seed, d_space, d_time):
    spikes, v = random_currents(seed).round().clamp(0, 1), random_currents(seed + 1, low=0.0, high=1.0)
    without = run_alif(spikes, v, ALIFParams(LIF, 0.0)).cumsum(0)
    with_diffusion = run_alif(spikes, v, ALIFParams(LIF, d_space, d_time)).cumsum(0)
    assert (with_diffusion >= without).all()


def test_a_potential_below_the_threshold_reaches_the_next_layer_only_by_diffusion():
    silent, v = torch.zeros(30, 1, 2, dtype=torch.float64), torch.full((30, 1, 2), 0.9, dtype=torch.float64)
    assert not run_alif(silent, v, ALIFParams(LIF, d_space=0.0)).any()
    assert run_alif(silent, v, ALIFParams(LIF, d_space=0.5)).any()


def test_each_neuron_may_have_its_own_diffusion_and_f_gets_the_sum():
    spikes, v = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.8]])
    d = torch.tensor([0.1, 0.25])
    torch.testing.assert_close(diffuse(spikes, v, d), torch.tensor([[1.05, 0.2]]))
    weight = torch.tensor([[1.0, 2.0], [0.5, -1.0], [0.0, 0.3]])
    params = ALIFParams(LIF, d_space=d, d_time=torch.tensor([0.1, 0.2, 0.3]))
    _, state = alif_step(spikes, v, LIFState(torch.tensor([[0.1, 0.2, 0.3]])), params, lambda z: z @ weight.T)
    by_hand = [0.9 * 0.1 + 1.05 + 0.4 + 0.01, 0.9 * 0.2 + 0.525 - 0.2 + 0.04, 0.9 * 0.3 + 0.06 + 0.09]
    assert by_hand[0] >= 1  # fires, and is reset
    torch.testing.assert_close(state.v, torch.tensor([[0.0, *by_hand[1:]]]))


def test_diffusion_in_time_is_a_slower_leak():
    state = LIFState(torch.full((1, 1), 0.8, dtype=torch.float64))
    silent = torch.zeros(1, 1, dtype=torch.float64)
    for _ in range(6):
        _, state = alif_step(silent, silent, state, ALIFParams(LIFParams(decay=0.5), 0.3, d_time=0.2), lambda z: z)
    assert state.v.item() == pytest.approx(0.8 * math.pow(0.7, 6))


# LTC


def ltc_by_hand(xs: list[float], w: LTCParams) -> list[tuple[float, float]]:
    """Yin's equations for one neuron in plain floats: (m, s) of every step."""
    m = s = 0.0
    steps = []
    for x in xs:
        d = w.w_x.item() * x + w.w_s.item() * s + w.b.item()
        a = 1 / (1 + math.exp(-(w.w_a[0, 0].item() * d + w.w_a[0, 1].item() * m + w.b_a.item())))
        m = m + (d - m) * a
        s = float(m >= w.v_th)
        m = m * (1 - s)
        steps.append((m, s))
    return steps


def one_ltc(w_x: float, w_s: float, b: float, w_a: tuple[float, float], b_a: float, v_th: float = 0.5) -> LTCParams:
    def tensor(*values: float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    return LTCParams(tensor(w_x)[None], tensor(w_s)[None], tensor(b), tensor(*w_a)[None], tensor(b_a), v_th)


def run_ltc(xs: list[float], params: LTCParams, m: float = 0.0) -> list[tuple[float, float]]:
    state = LTCState(torch.full((1, 1), m, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64))
    steps = []
    for x in xs:
        state = ltc_step(torch.full((1, 1), x, dtype=torch.float64), state, params)
        steps.append((state.m.item(), state.s.item()))
    return steps


def test_one_ltc_neuron_computes_its_equations_as_written_by_hand():
    params = one_ltc(0.9, -0.7, 0.1, (0.8, -0.5), 0.3)
    xs = [0.2, 0.9, 1.4, -0.3, 0.6, 0.7, 0.1, 1.2]
    expected = ltc_by_hand(xs, params)
    assert {s for _, s in expected} == {0.0, 1.0}
    for got, want in zip(run_ltc(xs, params), expected, strict=True):
        assert got == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize("a", [0.1, 0.5, 0.9])
def test_an_ltc_neuron_of_fixed_time_constant_leaks_geometrically(a):
    params = one_ltc(1.0, 0.0, 0.0, (0.0, 0.0), math.log(a / (1 - a)))
    m = [m for m, _ in run_ltc([0.0] * 6, params, m=0.4)]
    assert m == pytest.approx([0.4 * (1 - a) ** t for t in range(1, 7)])


def test_an_ltc_neuron_that_fires_is_reset_to_zero_without_a_gradient_through_the_reset():
    params = one_ltc(1.0, 0.0, 0.0, (0.0, 0.0), 0.0)  # a = 1/2: m = x / 2 at the first step
    x = torch.tensor([[0.8], [1.0], [7.0]], dtype=torch.float64, requires_grad=True)
    zeros = torch.zeros(3, 1, dtype=torch.float64)
    after = ltc_step(x, LTCState(zeros, zeros), params)
    assert after.s.flatten().tolist() == [0.0, 1.0, 1.0]
    assert after.m.flatten().tolist() == [0.4, 0.0, 0.0]
    (gradient,) = torch.autograd.grad(after.m.sum(), x)
    assert gradient.flatten().tolist() == [0.5, 0.0, 0.0]


# Modules


def make(name: str, **options) -> neurons.LIF | alif.ALIF | ltc.LTC:
    """A population of 4 neurons with 4 inputs that fires in some steps."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        if name == "LIF":
            return neurons.LIF(4, **options).double()
        if name == "ALIF":
            return alif.ALIF(4, 4, **{"v_th": 0.3, **options}).double()
        layer = ltc.LTC(4, 4, **options).double()
        torch.nn.init.uniform_(layer.w_x, 0.0, 1.0)
        return layer


each_module = pytest.mark.parametrize("name", ["LIF", "ALIF", "LTC"])


def step_of(module: torch.nn.Module, x: Tensor, state: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
    match module:
        case neurons.LIF():
            return lif_step(x, state, module.params())
        case alif.ALIF():
            return alif_step(x, torch.zeros_like(x), state, module.params(), module.f)
        case ltc.LTC():
            state = ltc_step(x, state, module.params())
            return state.s, state
    raise AssertionError(module)


@each_module
def test_a_module_equals_its_steps(name):
    module, x = make(name), random_currents(3)
    steps, last = module(x, module.initial_state(3))
    state = module.initial_state(3)
    for t, x_t in enumerate(x):
        spikes, state = step_of(module, x_t, state)
        assert torch.equal(steps.s[t], spikes)
    for one, other in zip(last, state, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)  # ALIF applies f to all steps at once
    assert 0 < steps.s.mean() < 1


@each_module
@pytest.mark.parametrize("cut", [1, 17, 49])
def test_a_module_stopped_after_k_steps_continues_from_its_state(name, cut):
    module, x = make(name), random_currents(4)
    whole, last = module(x, module.initial_state(3))
    first, middle = module(x[:cut], module.initial_state(3))
    second, end = module(x[cut:], type(middle)(*(field.clone() for field in middle)))
    assert torch.equal(torch.cat((first.s, second.s)), whole.s)
    for one, other in zip(end, last, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["LIF", "ALIF"])
def test_steps_return_the_potential_before_the_reset(name):
    module, x = make(name), random_currents(5)
    steps, last = module(x, module.initial_state(3))
    v_th = 1.0 if name == "LIF" else 0.3
    assert torch.equal(steps.s, (steps.v >= v_th).double())
    assert torch.equal(last.v, steps.v[-1] * (1 - steps.s[-1]))


@each_module
def test_neurons_keep_their_memory_under_a_constant_input(name):
    module = make(name, v_th=50.0)
    _, one = module(0.1 * torch.ones(1, 3, 4, dtype=torch.float64), module.initial_state(3))
    _, two = module(0.1 * torch.ones(2, 3, 4, dtype=torch.float64), module.initial_state(3))
    assert ((one[0] - two[0]).abs() > 1e-6).all()


def test_two_alif_layers_exchange_potentials_by_diffusion_in_space():
    below, above = make("ALIF", v_th=5.0), make("ALIF", d_space=0.4)
    steps, _ = below(random_currents(6), below.initial_state(3))
    assert not steps.s.any()
    with_v, _ = above(steps.s, above.initial_state(3), steps.v)
    by_hand, _ = above(0.4 * steps.v, above.initial_state(3))
    torch.testing.assert_close(with_v.v, by_hand.v)
    assert with_v.s.any()


@pytest.mark.parametrize("d_time", [0.0, 0.3])
def test_an_alif_neuron_of_the_module_leaks_with_decay_and_diffusion_in_time_together(d_time):
    module = make("ALIF", v_th=50.0, d_time=d_time, decay=0.5)
    torch.nn.init.zeros_(module.f.bias)
    steps, _ = module(torch.zeros(5, 3, 4, dtype=torch.float64), LIFState(torch.ones(3, 4, dtype=torch.float64)))
    torch.testing.assert_close(steps.v[-1], torch.full((3, 4), (0.5 + d_time) ** 5, dtype=torch.float64))


def test_both_diffusions_of_alif_learn():
    module, x = make("ALIF", surrogate="arctan"), random_currents(7)  # never zero, unlike the rectangle
    steps, _ = module(x, module.initial_state(3), x)
    gradients = torch.autograd.grad(steps.s.sum(), [module.d_space, module.d_time])
    assert all(gradient.all() for gradient in gradients)


@each_module
def test_below_the_threshold_the_gradient_of_a_module_is_the_derivative(name):
    module = make(name, v_th=50.0)
    x = random_currents(8, steps=3).requires_grad_()
    names = [name for name, _ in module.named_parameters()]

    def run(x: Tensor, *parameters: Tensor) -> Tensor:
        values = dict(zip(names, parameters, strict=True))
        args = (x, module.initial_state(3)) + ((x,) if isinstance(module, alif.ALIF) else ())
        steps, last = torch.func.functional_call(module, values, args)
        return steps[0].sum() + last[0]

    assert torch.autograd.gradcheck(run, (x, *(p.detach().clone().requires_grad_() for p in module.parameters())))


@pytest.mark.parametrize(
    ("call", "field", "bound"),
    [
        (lambda: neurons.LIF(0), "hidden", "at least 1"),
        (lambda: alif.ALIF(0, 3), "inputs", "at least 1"),
        (lambda: ltc.LTC(3, -2), "hidden", "at least 1"),
        (lambda: neurons.LIF(3, decay=1.0), "decay", "below 1"),
        (lambda: neurons.LIF(3, decay=-0.1), "decay", "at least 0"),
        (lambda: alif.ALIF(3, 3, decay=math.nan), "decay", "below 1"),
        (lambda: neurons.LIF(3, v_th=0.0), "v_th", "above 0"),
        (lambda: alif.ALIF(3, 3, v_th=-1.0), "v_th", "above 0"),
        (lambda: ltc.LTC(3, 3, v_th=math.inf), "v_th", "finite"),
        (lambda: alif.ALIF(3, 3, d_time=1.0), "d_time", "below 1"),
        (lambda: alif.ALIF(3, 3, d_space=-0.5), "d_space", "at least 0"),
        (lambda: neurons.LIF(3, surrogate="gaussian"), "surrogate", "rectangular, arctan, triangle"),
        (lambda: ltc.LTC(3, 3, surrogate="gaussian"), "surrogate", "rectangular, arctan, triangle"),
        (lambda: alif.ALIF(3, 3, surrogate_width=0.0), "surrogate_width", "above 0"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_value_and_bound(call, field, bound):
    with pytest.raises(InvalidField, match=bound) as caught:
        call()
    assert caught.value.details["field"] == field


@each_module
@pytest.mark.parametrize("shape", [(5, 3, 6), (3, 4), (4,), (0, 3, 4), (2, 5, 3, 4)])
def test_a_wrong_input_is_named_with_its_shape(name, shape):
    module = make(name)
    with pytest.raises(InvalidField, match=r"must be \(T, B, 4\)") as caught:
        module(torch.zeros(*shape, dtype=torch.float64), module.initial_state(3))
    assert caught.value.details["field"] == "x.shape"


@each_module
def test_a_state_of_another_batch_is_named_with_its_shape(name):
    module = make(name)
    with pytest.raises(InvalidField, match="state.shape") as caught:
        module(random_currents(0), module.initial_state(2))
    assert caught.value.details["bound"] == "must be (B, N) = (3, 4)"


def test_potentials_of_another_shape_and_a_step_of_another_width_are_rejected():
    alif, x = make("ALIF"), random_currents(0)
    with pytest.raises(InvalidField, match="v_before.shape"):
        alif(x, alif.initial_state(3), x[:-1])
    ltc = make("LTC")
    with pytest.raises(InvalidField, match="4 wide"):
        ltc_step(torch.zeros(3, 5, dtype=torch.float64), ltc.initial_state(3), ltc.params())
