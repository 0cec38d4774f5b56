"""Backpropagation through plain MLPs gives what autograd gives for their modules, and what differences of L give."""

import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_reinforce.backpropagation import squared_error, through
from sb3_reinforce.layers import DivideLogits

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


def test_a_gradient_lies_in_memory_as_its_parameter_does(mlp):
    """A fused optimizer goes through both side by side."""
    layers, parameters = mlp
    gradients = th.autograd.grad(through(layers, th.randn(7, 3)).sum(), parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        assert gradient.stride() == parameter.stride()


def test_frozen_parameters(mlp):
    layers, parameters = mlp
    parameters[0].requires_grad_(False)
    x = th.randn(7, 3)
    outputs = through(layers, x), nn.Sequential(*layers)(x)
    gradients, expected = (th.autograd.grad(output.sum(), parameters[1:]) for output in outputs)
    th.testing.assert_close(gradients, expected)


def test_a_second_derivative_is_refused():
    """It would lack what the activations contribute."""
    layers, parameters = make_layers("tanh")
    loss = through(layers, th.randn(7, 3)).square().sum()
    (gradient,) = th.autograd.grad(loss, parameters[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="twice"):
        gradient.sum().backward()


def test_weights_that_have_changed_meanwhile_are_refused():
    """Their δ would be that of a pass that was never made."""
    layers, parameters = make_layers("tanh")
    output = through(layers, th.randn(7, 3))
    with th.no_grad():
        parameters[-2].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        th.autograd.grad(output.sum(), parameters)
