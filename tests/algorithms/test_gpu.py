"""On a GPU a model learns as on the CPU, and can be saved there and loaded here. Skipped where there is no GPU."""

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch as th
from environments import Tree
from gymnasium import spaces
from models import Double, float64
from processes import TORCHRUN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.utils import set_random_seed

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import check_gradient, compare_baselines, compare_estimators, landscape
from sb3_reinforce.recurrent import RecurrentREINFORCE

pytestmark = [
    pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU"),
    pytest.mark.filterwarnings("ignore:You are trying to run:UserWarning"),
]

MULTI_INPUT = {"features_extractor_kwargs": {"cnn_output_dim": 16}}
KINDS: dict[str, tuple[type, str, Any, dict[str, Any]]] = {
    "critic": (REINFORCE, "MlpPolicy", "CartPole-v1", {"n_steps": 64}),
    "episodes": (REINFORCE, "MlpPolicy", "CartPole-v1", {"n_episodes": 6, "baseline": "leave_one_out"}),
    "optimal": (REINFORCE, "MlpPolicy", "CartPole-v1", {"n_episodes": 6, "baseline": "optimal"}),
    "scores": (REINFORCE, "MlpPolicy", "CartPole-v1", {"n_episodes": 6, "baseline": "none", "step": "natural"}),
    "natural": (REINFORCE, "MlpPolicy", "Pendulum-v1", {"n_steps": 200, "step": "natural"}),
    "gsde": (REINFORCE, "MlpPolicy", "Pendulum-v1", {"n_steps": 64, "use_sde": True}),
    "images": (REINFORCE, "MultiInputPolicy", SimpleMultiObsEnv, {"n_steps": 32, "policy_kwargs": MULTI_INPUT}),
    "natural images": (
        REINFORCE,
        "MultiInputPolicy",
        SimpleMultiObsEnv,
        {"n_steps": 32, "step": "natural", "policy_kwargs": {"share_features_extractor": False, **MULTI_INPUT}},
    ),
    "memory": (RecurrentREINFORCE, "MlpLstmPolicy", "CartPole-v1", {"n_steps": 64}),
    "natural memory": (RecurrentREINFORCE, "MlpLstmPolicy", "Pendulum-v1", {"n_steps": 64, "step": "natural"}),
    "search": (FiniteDifference, "MlpPolicy", "CartPole-v1", {"n_delta": 4, "estimator": "central"}),
    "forward search": (FiniteDifference, "LinearPolicy", "Pendulum-v1", {"n_delta": 4, "estimator": "forward"}),
}
all_kinds = pytest.mark.parametrize("kind", KINDS)


def make(kind: str, device: str) -> Any:
    algorithm, policy, env_id, arguments = KINDS[kind]
    # Some environments draw from NumPy's generator when they are made
    set_random_seed(0)
    return algorithm(policy, make_vec_env(env_id, 2, seed=0), seed=0, device=device, **arguments)


@pytest.fixture
def same_numbers(monkeypatch):
    """Both devices draw the same actions and noise; cuDNN takes float32, where it would take TF32."""
    monkeypatch.setattr(th.backends.cudnn, "allow_tf32", False)
    multinomial = th.multinomial

    def multinomial_on_the_cpu(probs, *args, **kwargs):
        return multinomial(probs.cpu(), *args, **kwargs).to(probs.device)

    def normal_on_the_cpu(self, sample_shape=()):
        return self.loc + self.scale * th.randn(*sample_shape, *self.loc.shape).to(self.loc)

    monkeypatch.setattr(th, "multinomial", multinomial_on_the_cpu)
    monkeypatch.setattr(th.distributions.Normal, "rsample", normal_on_the_cpu)


class DoubleLinear(Double):
    """With parameters it is shared by actor and critic, and the policy step descends the critic's error too."""

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space)
        self.linear = th.nn.Linear(self.features_dim, self.features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(super().forward(observations))


def parameters(model: Any) -> np.ndarray:
    return np.concatenate([values.detach().cpu().numpy().ravel() for values in model.policy.state_dict().values()])


@all_kinds
def test_a_gpu_learns_as_the_cpu_does(kind, same_numbers):
    models = [make(kind, device).learn(1) for device in ("cpu", "cuda")]
    before = parameters(make(kind, "cpu"))
    moved, on_the_gpu = [parameters(model) - before for model in models]
    assert np.linalg.norm(moved) > 0
    assert np.linalg.norm(on_the_gpu - moved) < 0.01 * np.linalg.norm(moved)
    assert all(parameter.is_cuda for parameter in models[1].policy.parameters())


@pytest.mark.parametrize("extractor", [Double, DoubleLinear])
def test_a_critic_in_float64_learns(extractor):
    with float64():
        kwargs = {"features_extractor_class": extractor}
        model = REINFORCE("MlpPolicy", Tree(), n_steps=16, device="cuda", policy_kwargs=kwargs)
    before = model.policy.value_net.weight.clone()
    model.learn(16)
    assert before.dtype is th.float64
    assert not th.equal(model.policy.value_net.weight, before)


@all_kinds
def test_a_model_of_a_gpu_predicts_the_same_on_the_cpu(kind, tmp_path):
    model = make(kind, "cuda").learn(1)
    model.save(tmp_path / "model")
    here = type(model).load(tmp_path / "model", device="cpu")
    assert np.array_equal(parameters(here), parameters(model))
    obs = model.get_env().reset()
    actions = [each.predict(obs, deterministic=True)[0] for each in (here, model)]
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-4)
    here.set_env(model.get_env())
    here.learn(1, reset_num_timesteps=False)


@pytest.mark.parametrize("kind", ["critic", "scores", "natural", "memory", "search", "forward search"])
def test_a_run_on_a_gpu_continues_as_if_it_had_not_stopped(kind, tmp_path):
    model = make(kind, "cuda").learn(1)
    model.save(tmp_path / "model")
    ends = []
    for is_resumed in (False, True):
        if is_resumed:
            model = type(model).load(tmp_path / "model", device="cuda", restore_random_state=True)
        model.set_env(make_vec_env(KINDS[kind][2], 2, seed=1))
        ends.append(parameters(model.learn(1, reset_num_timesteps=False)))
    np.testing.assert_allclose(*ends, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["critic", "scores", "natural", "search"])
def test_the_laboratory_measures_on_a_gpu(kind):
    model = make(kind, "cuda")
    assert np.isfinite(landscape(model, n_points=3, n_episodes=2).utilities).all()
    compare_estimators(model, 8, 3, n_resamples=2)
    if isinstance(model, REINFORCE):
        assert check_gradient(model).passed
        assert np.isfinite([row.variance.value for row in compare_baselines(model, 8, n_resamples=2)]).all()


def test_generators_of_gpus_go_on_after_a_measurement():
    model = REINFORCE("MlpPolicy", Tree(), device="cuda")
    before = th.cuda.get_rng_state_all()
    tables = [compare_baselines(model, 20, n_resamples=2).to_records() for _ in range(2)]
    assert [row["variance"] for row in tables[0]] == [row["variance"] for row in tables[1]]
    assert check_gradient(model).passed
    assert all(map(th.equal, th.cuda.get_rng_state_all(), before))


TRAIN = """
import os, sys
import torch as th
from test_gpu import KINDS, make

rank = int(os.environ["RANK"])
for kind in KINDS:
    model = make(kind, sys.argv[1 + rank]).learn(300)
    state = {name: values.cpu() for name, values in model.policy.state_dict().items()}
    th.save((state, model.num_timesteps), f"{sys.argv[3]}/{kind} {rank}")
"""


@pytest.mark.parametrize("devices", [("cuda", "cuda"), ("cuda", "cpu"), ("cpu", "cuda")])
def test_two_processes_learn_on_any_devices(devices, tmp_path):
    (tmp_path / "train.py").write_text(TRAIN)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([*TORCHRUN, tmp_path / "train.py", *devices, tmp_path], env=environment, timeout=300, check=True)
    for kind in KINDS:
        (first, steps), (second, _) = [th.load(tmp_path / f"{kind} {rank}") for rank in range(2)]
        assert steps >= 300
        before = make(kind, "cpu").policy.state_dict()
        assert any(not th.equal(first[name], before[name]) for name in first)
        assert all(th.equal(first[name], second[name]) for name in first)


def test_a_policy_with_a_temperature_can_be_moved_to_the_cpu():
    model = REINFORCE("MlpPolicy", "CartPole-v1", temperature=0.5, device="cuda", seed=0)
    model.policy.to("cpu")
    actions, _ = model.predict(np.zeros((3, 4), np.float32))
    assert actions.shape == (3,)
