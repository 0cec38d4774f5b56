"""Where V comes from, and that a features extractor is evaluated no more often than it must be."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.critic import fit_critic, values_of

N_STEPS, N_ENVS = 7, 3


class OwnCritic(ActorCriticPolicy):
    """The same values, by a method of its own."""

    def predict_values(self, obs):
        return super().predict_values(obs)


class OwnCnnCritic(ActorCriticCnnPolicy):
    """The same values, by a method of its own."""

    def predict_values(self, obs):
        return super().predict_values(obs)


OWN = {"MlpPolicy": OwnCritic, "CnnPolicy": OwnCnnCritic}


def make(policy, **kwargs):
    is_image, image = "Cnn" in str(policy), {"screen_height": 36, "screen_width": 36}
    env = make_vec_env(FakeImageEnv if is_image else Corridor, N_ENVS, 0, env_kwargs=image if is_image else {})
    return REINFORCE(policy, env, **{"n_steps": N_STEPS, "seed": 0, "device": "cpu", **kwargs})


def observations(buffer):
    return th.as_tensor(buffer.observations).flatten(0, 1)


@pytest.mark.parametrize(
    ("policy", "kwargs"),
    [("MlpPolicy", {}), ("MlpPolicy", {"activation_fn": th.nn.ReLU}), ("CnnPolicy", {}), (OwnCnnCritic, {})],
)
def test_values_are_the_policys(policy, kwargs):
    """Laid out, told along with the actions, or asked for in one batch."""
    model = make(policy, learning_rate=0.0, policy_kwargs=kwargs).learn(1)
    with th.no_grad():
        expected = model.policy.predict_values(observations(model.rollout_buffer)).reshape(N_STEPS, N_ENVS)
    values = values_of(model.policy, model.rollout_buffer)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-6)
    assert np.std(values) > 1e-3


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("policy", OWN)
def test_a_kept_features_extractor_gives_the_same_critic(policy, share):
    """As many passes over the same data, from kept features and from the observations."""
    kwargs = {"policy_kwargs": {"share_features_extractor": share}}
    short, long = make(policy, **kwargs), make(OWN[policy], **kwargs)
    obs, returns = observations(short.learn(1).rollout_buffer), th.randn(N_STEPS * N_ENVS)
    long.policy.load_state_dict(short.policy.state_dict())
    fitted = []
    for model in (short, long):
        names = ["value_net", "mlp_extractor.value_net", *([] if share else ["vf_features_extractor"])]
        critic = [parameter for name in names for parameter in model.policy.get_submodule(name).parameters()]
        th.manual_seed(1)
        fit_critic(model.policy, th.optim.SGD(critic, 1e-3), critic, obs, returns, 3, 5, None)
        fitted.append(critic)
    for mine, other in zip(*fitted, strict=True):
        th.testing.assert_close(mine, other, rtol=1e-5, atol=1e-6)
    assert not th.equal(fitted[0][0], make(policy, **kwargs).policy.value_net.weight)


@pytest.mark.parametrize("baseline", ["value", "none"])
def test_how_often_a_shared_features_extractor_is_evaluated(baseline):
    """For each step and for the policy's; with a critic for its passes and the last observations, else for log π."""
    mode = {"n_steps": 10} if baseline == "value" else {"n_steps": None, "n_episodes": N_ENVS}
    model = make("CnnPolicy", baseline=baseline, n_critic_updates=5, **mode)
    model.learn(1)
    calls = []
    model.policy.features_extractor.register_forward_hook(lambda *args: calls.append(1))
    model.learn(1)
    n_steps = 10  # the length of every episode, which a time limit ends
    assert len(calls) == n_steps + 1 + (1 + 2 if baseline == "value" else 1)
