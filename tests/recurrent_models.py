"""Recurrent policies in float64, and what sb3-contrib's own methods say of them, one step at a time."""

from contextlib import nullcontext

import numpy as np
import torch as th
from environments import Random
from gymnasium import spaces
from models import Double, float64
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

from sb3_reinforce.recurrent import RecurrentREINFORCE

VECTOR = spaces.Box(-1, 1, (3,))
IMAGE = spaces.Box(0, 255, (1, 4, 4), np.uint8)
SPACES = {
    "MlpLstmPolicy": VECTOR,
    "CnnLstmPolicy": IMAGE,
    "MultiInputLstmPolicy": spaces.Dict(a=VECTOR, b=spaces.Discrete(3)),
}
EXACT = {"rtol": 1e-9, "atol": 1e-10}


class DoubleCombined(CombinedExtractor):
    """As Double, for Dict observations."""

    def forward(self, observations):
        return super().forward(observations).double()


def make_recurrent(policy="MlpLstmPolicy", env=None, double=True, policy_kwargs=None, **kwargs):
    """A small model with weights so large that memories matter."""
    if env is None:
        env = make_vec_env(lambda: Random(SPACES[policy], lengths=(2, 5, 7)), 2, seed=0)
    extractors = (DoubleCombined, CombinedExtractor) if policy == "MultiInputLstmPolicy" else (Double, FlattenExtractor)
    policy_kwargs = {"lstm_hidden_size": 4, "net_arch": [3], **(policy_kwargs or {})}
    policy_kwargs["features_extractor_class"] = extractors[0 if double else 1]
    th.manual_seed(0)
    with float64() if double else nullcontext():
        model = RecurrentREINFORCE(policy, env, seed=0, device="cpu", policy_kwargs=policy_kwargs, **kwargs)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_(std=0.7)
    return model


def at(obs, t):
    return {key: th.as_tensor(part[t]) for key, part in obs.items()} if isinstance(obs, dict) else th.as_tensor(obs[t])


def by_steps(policy, obs, dones, state):
    """Logits and values of each step by sb3-contrib's methods, from a state ``(n_envs, 2, 2, n_layers, n_hidden)``."""
    halves = state.permute(1, 2, 3, 0, 4)
    states = RNNStates(tuple(halves[0]), tuple(halves[1]))
    starts = th.zeros(dones.shape[1], dtype=state.dtype)
    logits, values = [], []
    for t, done in enumerate(dones):
        logits.append(policy.get_distribution(at(obs, t), states.pi, starts)[0].distribution.logits)
        _, value, _, states = policy(at(obs, t), states, starts)
        values.append(value)
        starts = th.as_tensor(done).to(starts)
    return th.cat(logits), th.cat(values)


def set_n_steps(model):
    """From the second rollout on."""
    if model.num_timesteps > 0:
        model.n_steps, model.n_episodes = 4, None
