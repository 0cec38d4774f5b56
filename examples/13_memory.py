# %% [markdown]
# # When must a policy remember?
#
# In a T-maze (Bakker, 2001) the first observation says whether the goal is to the left or to the right of the junction
# at the end of a corridor. Every later one only says whether this is the junction. The turn towards the goal earns 1
# and the other one −1, so a policy without a memory can do no better than 0. The likelihood ratio holds for partial
# observations as it stands: only $\log \pi$ is differentiated, now back through the memory to the start of each
# episode.
#
# As a script it takes arguments: `python examples/13_memory.py --length 20 --memory rnn --timesteps 200000`.

# %%
import argparse
import sys

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce import REINFORCE
from sb3_reinforce.recurrent import RecurrentREINFORCE

parser = argparse.ArgumentParser()
parser.add_argument("--length", type=int, default=5, help="steps from the cue to the junction")
parser.add_argument("--memory", choices=("none", "rnn", "gru", "lstm"), default="rnn")
parser.add_argument("--forget-bias", type=float, default=0.0, help="of the forget gates of lstm before training")
parser.add_argument("--timesteps", type=int, default=45_000)
parser.add_argument("--seed", type=int, default=0)
# A notebook is started with other arguments
arguments = parser.parse_args([] if "ipykernel" in sys.modules else None)
th.set_num_threads(1)


# %%
class TMaze(gym.Env):
    """Actions: walk on, turn left, turn right; a turn in the corridor and a step on at the junction cost 0.1."""

    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Discrete(3)

    def __init__(self, length):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = self.position = 0
        self.cue = 1 - 2 * int(self.np_random.integers(2))
        return self.observe(), {}

    def observe(self):
        is_junction = self.position == self.length
        return np.array([self.cue * (self.t == 0), not is_junction, is_junction], dtype=np.float32)

    def step(self, action):
        self.t += 1
        is_turn = action > 0
        if self.position == self.length and is_turn:
            return self.observe(), 1.0 if (action == 1) == (self.cue == 1) else -1.0, True, False, {}
        reward = -0.1 if is_turn or self.position == self.length else 0.0
        self.position = min(self.position + 1 - is_turn, self.length)
        return self.observe(), reward, False, self.t >= 3 * self.length, {}


# %% [markdown]
# The memory is an Elman network with orthogonal weights, which keeps a signal for long. The gates of an LSTM start half
# open, and the cue fades; `--forget-bias 2` keeps it longer. The policy must still explore when it discovers that the
# cue matters, so the entropy bonus falls to 0 only at the end. `"MlpLstmPolicy"` and
# `lstm_hidden_size` are SB3-Contrib's names, whatever the cell is; `memory` chooses the cell.

# %%
settings = {
    "baseline": "leave_one_out",
    "n_episodes": 32,
    "gamma": 1.0,
    "learning_rate": LinearSchedule(3e-3, 0.0, 1.0),
    "ent_coef": LinearSchedule(0.05, 0.0, 1.0),
    "seed": arguments.seed,
    "device": "cpu",
}


def score(memory):
    """Train with a memory, and return the mean return of 200 episodes."""
    env_kwargs = {"length": arguments.length}
    env = make_vec_env(TMaze, n_envs=16, seed=arguments.seed, env_kwargs=env_kwargs)
    if memory == "none":
        model = REINFORCE("MlpPolicy", env, **settings)
    else:
        policy_kwargs = {"memory": memory, "lstm_hidden_size": 32}
        model = RecurrentREINFORCE("MlpLstmPolicy", env, policy_kwargs=policy_kwargs, **settings)
        if memory == "lstm":
            # PyTorch's order of the gates: input, forget, cell, output
            with th.no_grad():
                model.policy.lstm_actor.bias_ih_l0[32:64] = arguments.forget_bias
    model.learn(arguments.timesteps, progress_bar=True)
    eval_env = make_vec_env(TMaze, n_envs=16, seed=1000 + arguments.seed, env_kwargs=env_kwargs)
    mean, _ = evaluate_policy(model, eval_env, n_eval_episodes=200)
    return mean


mean = score(arguments.memory)
print(f"Mean return of 200 episodes with memory {arguments.memory!r}: {mean:.2f} (best 1, by guessing 0)")
# Longer corridors and other memories may need more steps, or not be learned
if (arguments.length, arguments.memory) == (5, "rnn") and arguments.timesteps >= 45_000:
    assert mean > 0.8, mean

# %% [markdown]
# A policy must remember when the past holds what the present does not show. Without a memory the same number of steps
# ends at a guess: at most 0 in expectation.

# %%
without_memory = score("none")
print(f"Mean return of 200 episodes without a memory: {without_memory:.2f}")
assert without_memory < 0.3
