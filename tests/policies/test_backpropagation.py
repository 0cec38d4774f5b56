"""Backpropagation through plain MLPs gives what autograd gives for their modules, and what differences of L give."""

import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_reinforce.common.optimization import step
from sb3_reinforce.policies.backpropagation import squared_error, tanh, through
from sb3_reinforce.policies.plain_mlp import DivideLogits

MLPS = {
    "tanh": lambda: [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 5), nn.Tanh(), nn.Linear(5, 2)],
    "relu": lambda: [nn.Linear(3, 5), nn.ReLU(), nn.Linear(5, 2)],
    "linear": lambda: [nn.Linear(3, 2)],
    "one output": lambda: [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1)],
    "two activations": lambda: [nn.Linear(3, 5), nn.Tanh(), nn.Tanh(), nn.ReLU(), nn.Linear(5, 4), nn.Linear(4, 2)],
    "activation first": lambda: [nn.Tanh(), nn.Linear(3, 5), nn.ReLU(), nn.Tanh(), nn.Linear(5, 2)],
}


def make_layers(name):
    th.manual_seed(0)
    layers = MLPS[name]()
    for parameter in nn.Sequential(*layers).parameters():
        nn.init.normal_(parameter)
    return layers, list(nn.Sequential(*layers).parameters())


@pytest.fixture(params=MLPS)
def mlp(request):
    return make_layers(request.param)


@pytest.mark.parametrize("temperature", [None, 0.3])
def test_value_and_gradient_are_those_of_the_modules(mlp, temperature):
    layers, parameters = mlp
    if temperature is not None:
        layers[-1].register_forward_hook(DivideLogits(th.tensor(temperature)))
    x = th.randn(7, 3)
    expected, before = nn.Sequential(*layers)(x), x.clone()
    output = through(layers, x)
    th.testing.assert_close(output, expected)
    assert th.equal(x, before)
    weights = th.randn(expected.shape)
    gradients, expected_gradients = (th.autograd.grad((weights * y).sum(), parameters) for y in (output, expected))
    th.testing.assert_close(gradients, expected_gradients)


def test_the_gradient_is_the_derivative(mlp):
    layers, _ = mlp
    nn.Sequential(*layers).double()
    parameters = list(nn.Sequential(*layers).parameters())
    x = th.randn(4, 3, dtype=th.double)
    assert th.autograd.gradcheck(lambda *_: through(layers, x), parameters)


@pytest.mark.parametrize("name", [name for name in MLPS if name != "two activations"])
def test_the_squared_error_and_its_gradient(name):
    layers, _ = make_layers(name)
    layers[-1] = nn.Linear(layers[-1].in_features, 1)
    some = [layers[-1].bias, next(layer for layer in layers if isinstance(layer, nn.Linear)).weight]
    x, targets = th.randn(7, 3), th.randn(7)
    error, gradients = squared_error(layers, some, x, targets)
    expected = F.mse_loss(nn.Sequential(*layers)(x).flatten(), targets)
    assert not error.requires_grad
    th.testing.assert_close(error, expected.detach())
    th.testing.assert_close(gradients, list(th.autograd.grad(expected, some)))


def test_frozen_parameters(mlp):
    layers, parameters = mlp
    parameters[0].requires_grad_(False)
    x = th.randn(7, 3)
    outputs = through(layers, x), nn.Sequential(*layers)(x)
    gradients, expected = (th.autograd.grad(output.sum(), parameters[1:]) for output in outputs)
    th.testing.assert_close(gradients, expected)


@pytest.mark.parametrize("loss", [lambda y: y.square().sum(), lambda y: y.sum()])
def test_a_second_derivative_is_refused(loss):
    """It would lack what the activations contribute, also where other terms reach all parameters."""
    layers, parameters = make_layers("tanh")
    with pytest.raises(NotImplementedError, match=r"policy\.evaluate_actions"):
        th.autograd.grad(loss(through(layers, th.randn(7, 3))), parameters, create_graph=True)


def test_the_gradient_is_that_of_the_pass():
    """Whatever becomes of the modules between the pass and its gradient."""
    layers, parameters = make_layers("tanh")
    x = th.randn(7, 3)
    expected = th.autograd.grad(nn.Sequential(*layers)(x).sum(), parameters)
    with th.autograd.graph.save_on_cpu():
        output = through(layers, x)
        layers[-1].weight = nn.Parameter(th.zeros_like(layers[-1].weight))
        th.testing.assert_close(th.autograd.grad(output.sum(), parameters), expected)


@pytest.mark.parametrize("changed", ["weights", "temperature"])
def test_what_has_been_written_over_meanwhile_is_refused(changed):
    """The δ would be that of a pass that was never made."""
    layers, parameters = make_layers("tanh")
    temperature = th.tensor(0.3)
    layers[-1].register_forward_hook(DivideLogits(temperature))
    output = through(layers, th.randn(7, 3))
    with th.no_grad():
        (parameters[-2] if changed == "weights" else temperature).mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        th.autograd.grad(output.sum(), parameters)


def test_tanh_on_other_devices():
    """No more can be seen of them here than that it is asked for, and where it writes."""
    x = th.ones(2, 3, device="meta")
    assert tanh(x, in_place=True) is x
    assert tanh(x, in_place=False).shape == x.shape


@pytest.mark.parametrize("fused", [True, False])
def test_a_step_reads_a_gradient_as_its_parameter_lies_in_memory(fused):
    """A fused optimizer goes through both side by side."""
    rows, columns = (nn.Parameter(w) for w in (th.arange(6.0).view(2, 3), th.arange(6.0).view(2, 3).T.contiguous().T))
    gradient = th.tensor([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]])
    assert rows.stride() != columns.stride()
    for parameter in (rows, columns):
        adam = th.optim.Adam([parameter], lr=0.1, fused=fused)
        assert step(adam, [parameter], [gradient], None, "policy") == pytest.approx(6**0.5)
    th.testing.assert_close(rows.detach(), th.arange(6.0).view(2, 3) - 0.1 * gradient)
    assert th.equal(rows, columns)


def test_a_step_takes_a_gradient_of_another_precision():
    """As autocast makes it."""
    parameter = nn.Parameter(th.zeros(2))
    step(th.optim.SGD([parameter], lr=1.0), [parameter], [th.tensor([1.0, 2.0]).half()], None, "policy")
    assert parameter.tolist() == [-1, -2]
