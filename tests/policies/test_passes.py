"""Passes through plain MLPs for a handful of observations compute what the modules would."""

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_reinforce.policies import passes
from sb3_reinforce.policies.passes import lay_out

MLPS = {
    "tanh": [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 2)],
    "relu": [nn.Linear(3, 5), nn.ReLU(), nn.Linear(5, 2)],
    "linear": [nn.Linear(3, 2)],
    "one output": [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1)],
    "two activations": [nn.Linear(3, 5), nn.Tanh(), nn.ReLU(), nn.Linear(5, 4), nn.Linear(4, 2)],
}


@pytest.fixture(params=MLPS)
def layers(request):
    th.manual_seed(0)
    layers = MLPS[request.param]
    for parameter in nn.Sequential(*layers).parameters():
        nn.init.normal_(parameter)
    return layers


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("one_thread", [passes.ONE_THREAD, 0], ids=["by NumPy", "by PyTorch"])
def test_a_laid_out_mlp_is_the_mlp(layers, one_thread, n, monkeypatch):
    monkeypatch.setattr(passes, "ONE_THREAD", one_thread)
    forward, obs = lay_out(layers, n), th.randn(3, n, 3)
    # All of them before any is compared: an output must not change with the next observations
    outputs = [forward(batch.numpy()) for batch in obs]
    np.testing.assert_allclose(outputs, nn.Sequential(*layers)(obs).detach().numpy(), rtol=1e-4, atol=1e-5)


def test_observations_of_other_kinds_and_shapes(layers):
    obs = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)
    expected = nn.Sequential(*layers)(th.as_tensor(obs).flatten(1).float()).detach().numpy()
    np.testing.assert_allclose(lay_out(layers, 2)(obs), expected, rtol=1e-4, atol=1e-5)


def test_parameters_are_those_of_the_moment_it_was_laid_out():
    layer = nn.Linear(3, 2)
    forward, obs = lay_out([layer], 1), np.ones((1, 3), dtype=np.float32)
    before = forward(obs)
    nn.init.zeros_(layer.weight)
    np.testing.assert_array_equal(forward(obs), before)
    assert lay_out([layer], 1)(obs).ravel().tolist() == layer.bias.tolist()
