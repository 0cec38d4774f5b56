"""The fast passes of plain MLPs compute what the modules compute."""

import copy
from itertools import product

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies import plain_mlp
from sb3_reinforce.policies.evaluation import calls
from sb3_reinforce.policies.plain_mlp import DivideLogits, has_numpy_form, numpy_forward

MLPS = {
    "tanh": [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 2)],
    "relu": [nn.Linear(3, 5), nn.ReLU(), nn.Linear(5, 2)],
    "linear": [nn.Linear(3, 2)],
    "one output": [nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1)],
    "two activations": [nn.Linear(3, 5), nn.Tanh(), nn.ReLU(), nn.Linear(5, 4), nn.Linear(4, 2)],
}


@pytest.fixture(params=product(MLPS, (None, 0.3)), ids=str)
def layers(request):
    name, temperature = request.param
    layers = copy.deepcopy(MLPS[name])
    for parameter in nn.Sequential(*layers).parameters():
        nn.init.normal_(parameter)
    if temperature is not None:
        layers[-1].register_forward_hook(DivideLogits(th.tensor(temperature)))
    return layers


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("one_thread", [plain_mlp.ONE_THREAD, 0], ids=["by NumPy", "by PyTorch"])
def test_the_numpy_pass_is_the_modules(layers, one_thread, n, monkeypatch):
    monkeypatch.setattr(plain_mlp, "ONE_THREAD", one_thread)
    forward = numpy_forward(layers, n)
    obs = th.randn(3, n, 3)
    before = obs.clone()
    outputs = [forward(batch.numpy()).copy() for batch in obs]
    np.testing.assert_allclose(outputs, nn.Sequential(*layers)(obs).detach().numpy(), rtol=1e-4, atol=1e-5)
    assert th.equal(obs, before), "observations are not written to"


def test_observations_of_other_kinds_and_shapes(layers):
    obs = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)
    expected = nn.Sequential(*layers)(th.as_tensor(obs).flatten(1).float()).detach().numpy()
    np.testing.assert_allclose(numpy_forward(layers, 2)(obs), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("one_thread", [plain_mlp.ONE_THREAD, 0], ids=["by NumPy", "by PyTorch"])
def test_changes_in_place_count_at_once(one_thread, monkeypatch):
    monkeypatch.setattr(plain_mlp, "ONE_THREAD", one_thread)
    layer = nn.Linear(3, 2)
    forward = numpy_forward([layer], 1)
    with th.no_grad():
        layer.weight.fill_(1)
        layer.bias.fill_(2)
    assert forward(np.ones((1, 3), dtype=np.float32)).tolist() == [[5, 5]]


def test_other_layers_and_precisions_have_no_numpy_form():
    assert has_numpy_form([nn.Linear(3, 2)])
    assert not has_numpy_form([nn.Linear(3, 2).double()])
    assert not has_numpy_form([nn.Linear(3, 2), nn.ELU()])
    # The observation itself would be overwritten
    assert not has_numpy_form([nn.Tanh(), nn.Linear(3, 2)])


def test_numpy_never_warns_as_pytorch_does_not():
    layer = nn.Linear(3, 2)
    nn.init.constant_(layer.weight, th.finfo(th.float32).max)
    assert np.isinf(numpy_forward([layer], 1)(np.ones((1, 3), dtype=np.float32))).all()


def test_a_compiled_policy_is_called_itself():
    """Its methods would bypass what was compiled."""
    policy = th.compile(REINFORCE("MlpPolicy", "CartPole-v1", device="cpu").policy, backend="eager")
    assert calls(policy, "forward") and calls(policy, "evaluate_actions")
