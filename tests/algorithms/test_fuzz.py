"""
Random configurations: valid ones train, stay finite and count exactly, and invalid ones are named.

``FUZZ_EXAMPLES=10000 pytest tests/algorithms/test_fuzz.py`` tries ten thousand valid ones of each instead of
twenty-five.
"""

import os
import re
import warnings

import numpy as np
import pytest
from environments import Corridor, Random
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference

TABLES = {algorithm: algorithm._arguments for algorithm in (REINFORCE, FiniteDifference)}

N_EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", 25))
fuzzed = settings(
    max_examples=N_EXAMPLES,
    deadline=None,
    derandomize="FUZZ_EXAMPLES" not in os.environ,
    suppress_health_check=list(HealthCheck),
    database=None,
)


class Counts(BaseCallback):
    """Checks at each step and rollout what can be counted."""

    def _on_step(self):
        assert self.num_timesteps == sum(self.training_env.get_attr("n_steps"))
        return True

    def _on_rollout_end(self):
        if isinstance(self.model, REINFORCE):
            buffer = self.model.rollout_buffer
            assert buffer.full and self.model.n_steps in (None, buffer.buffer_size)
            for rows in (buffer.rewards, buffer.advantages, buffer.returns, buffer.log_probs):
                assert rows.shape == (buffer.buffer_size, self.model.n_envs) and np.isfinite(rows).all()


sizes = st.integers(1, 3)
boxes = st.builds(lambda n, high: spaces.Box(-high, high, (n,)), sizes, st.sampled_from([1.0, 10.0]))
flat = st.one_of(
    boxes,
    st.builds(lambda n, m: spaces.Box(0, 1, (n, m), np.float64), sizes, sizes),
    sizes.map(spaces.Discrete),
    st.builds(lambda n: spaces.MultiDiscrete([n, 2]), sizes),
    sizes.map(spaces.MultiBinary),
)
observations = st.one_of(flat, st.dictionaries(st.sampled_from(["a", "b"]), flat, min_size=1).map(spaces.Dict))
actions = st.one_of(
    boxes,
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(2, 4), st.integers(-2, 2)),
    st.builds(lambda n: spaces.MultiDiscrete([n, 2]), st.integers(2, 3)),
    sizes.map(spaces.MultiBinary),
)
floats = st.floats


@st.composite
def environments(draw):
    observation_space, action_space = draw(observations), draw(actions)
    lengths, truncate = tuple(range(1, draw(st.integers(2, 7)))), draw(st.booleans())
    make = lambda: Monitor(Random(observation_space, action_space, lengths, truncate))  # noqa: E731
    env = DummyVecEnv([make] * draw(st.integers(1, 4)))
    if isinstance(observation_space, spaces.Box):
        wrapper = draw(st.sampled_from(["none", "normalize", "both"]))
        env = env if wrapper == "none" else VecNormalize(env)
        env = VecFrameStack(env, 2) if wrapper == "both" and len(observation_space.shape) == 1 else env
    env.seed(draw(st.integers(0, 99)))
    return env


COMMON = {
    "learning_rate": st.one_of(floats(0, 1), st.builds(lambda top: lambda p: top * p, floats(0, 1))),
    "max_grad_norm": st.one_of(st.none(), floats(0.01, 10)),
    "seed": st.integers(0, 2**31),
}
REINFORCE_STRATEGIES = COMMON | {
    **dict.fromkeys(("gamma", "ent_coef", "vf_coef"), floats(0, 1)),
    **dict.fromkeys(("reward_to_go", "discount_scores", "normalize_advantage"), st.booleans()),
    "baseline": st.sampled_from(["none", "mean", "time_mean", "leave_one_out", "value", "optimal"]),
    "normalize_by": st.sampled_from(["steps", "episodes"]),
    "n_critic_updates": st.integers(1, 3),
    "batch_size": st.integers(1, 64),
}
FINITE_DIFFERENCE_STRATEGIES = COMMON | {
    "estimator": st.sampled_from(["regression", "central", "forward"]),
    "perturbation": st.sampled_from(["sphere", "gaussian", "rademacher", "coordinate"]),
    "delta_std": st.one_of(st.none(), floats(1e-3, 1), st.just(lambda p: 0.1 + p)),
    "n_eval_episodes": st.integers(1, 2),
    **dict.fromkeys(("common_random_numbers", "standardize_utilities", "deterministic"), st.booleans()),
}


# Arguments that go with a critic, with a kind of actions, or with a kind of step
WITH_CRITIC = {"gae_lambda": floats(0, 1), "critic_learning_rate": st.one_of(st.none(), floats(0, 1))}
OF_A_BOX = {
    "min_std": st.one_of(floats(0, 2), st.just(lambda p: 2 * p)), "use_sde": st.booleans(),
    "sde_sample_freq": st.integers(-1, 4),
}  # fmt: skip
OF_NUMBERS = {"temperature": st.one_of(floats(0.1, 10), st.just(lambda p: 0.5 * p))}
OF_A_NATURAL_STEP = {"target_kl": st.one_of(st.none(), floats(0, 0.1), st.just(lambda p: 0.01 * p))}
WITH_PAIRS = {"n_top": st.integers(1, 2)}
# What other tests vary
LEFT_OUT = {
    "policy", "policy_kwargs", "device", "verbose", "tensorboard_log", "stats_window_size", "max_episode_steps",
    "rollout_buffer_class", "rollout_buffer_kwargs", "episodes_per_start",
}  # fmt: skip


def test_every_argument_is_drawn_or_left_out():
    own = REINFORCE_STRATEGIES | WITH_CRITIC | OF_A_BOX | OF_NUMBERS | OF_A_NATURAL_STEP
    assert own.keys() | LEFT_OUT | {"step", "n_steps", "n_episodes"} == TABLES[REINFORCE].keys()
    searched = FINITE_DIFFERENCE_STRATEGIES.keys() | WITH_PAIRS.keys() | {"n_delta"}
    assert searched | LEFT_OUT >= TABLES[FiniteDifference].keys() >= searched


@st.composite
def reinforce_runs(draw):
    env = draw(environments())
    of_actions = OF_A_BOX if isinstance(env.action_space, spaces.Box) else OF_NUMBERS
    chosen = draw(st.fixed_dictionaries({}, optional=REINFORCE_STRATEGIES | of_actions))
    has_critic = chosen.get("baseline", "value") == "value"
    if has_critic and chosen.get("reward_to_go", True):
        chosen |= draw(st.fixed_dictionaries({}, optional=WITH_CRITIC))
    if draw(st.booleans()):
        chosen |= {"step": "natural", **draw(st.fixed_dictionaries({}, optional=OF_A_NATURAL_STEP))}
    # Without a critic some episode must end: the longest has 6 steps
    n_steps = draw(st.integers(1, 9)) if has_critic else draw(st.integers(6, 9))
    return env, {**chosen, **({"n_episodes": draw(st.integers(2, 6))} if draw(st.booleans()) else {"n_steps": n_steps})}


@st.composite
def searches(draw):
    chosen = draw(st.fixed_dictionaries({"n_delta": st.integers(2, 5)}, optional=FINITE_DIFFERENCE_STRATEGIES))
    if chosen.get("estimator") == "central":
        chosen |= draw(st.fixed_dictionaries({}, optional=WITH_PAIRS))
    return chosen


def assert_trains(algorithm, env, arguments):
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    model = algorithm(policy, env, device="cpu", policy_kwargs={"net_arch": [4]}, **arguments)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Episodes that n_steps cuts are left out")
        warnings.filterwarnings("ignore", "normalize_by='episodes' has no effect")
        warnings.filterwarnings("ignore", "n_delta=. perturbations do not determine")
        warnings.filterwarnings("ignore", "The natural step is left out")
        model.learn(30, Counts())
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert model.num_timesteps == sum(env.get_attr("n_steps")) >= 30
    n_episodes = sum(env.get_attr("n_episodes"))
    if algorithm is REINFORCE and model.n_steps is not None:
        assert len(model.ep_info_buffer) == min(n_episodes, 100)
        assert model.num_timesteps == model._n_updates * model.n_steps * env.num_envs
    elif algorithm is REINFORCE:
        assert len(model.ep_info_buffer) == min(model._n_updates * model.n_episodes, 100)
    else:
        k = model.n_delta
        n_candidates = model._n_updates * {"regression": k, "central": 2 * k, "forward": k + 1}[model.estimator]
        assert len(model.ep_info_buffer) == min(n_candidates * model.n_eval_episodes, 100) <= n_episodes


@fuzzed
@given(reinforce_runs())
def test_valid_reinforce(run):
    assert_trains(REINFORCE, *run)


@fuzzed
@given(environments(), searches())
def test_valid_search(env, arguments):
    assert_trains(FiniteDifference, env, arguments)


ODD = ["x", None, [1], float("nan"), float("inf"), -float("inf"), True, 1j, b"mean", object(), -1, 0, {}, ()]
# Greater numbers of steps are valid, and take long
numbers = st.one_of(st.integers(max_value=20), st.floats())
anything = st.one_of(st.sampled_from(ODD), numbers, st.text(max_size=3))


@pytest.mark.filterwarnings(r"ignore:n_delta=\d+ perturbations do not determine")
@pytest.mark.parametrize("algorithm", TABLES)
@settings(fuzzed, max_examples=4 * N_EXAMPLES)
@given(data=st.data())
def test_a_random_value_trains_or_is_named(algorithm, data):
    name = data.draw(st.sampled_from(sorted(TABLES[algorithm].keys() - {"tensorboard_log"})))
    value = data.draw(st.one_of(anything, anything.map(lambda value: lambda *args: value)))
    env = Monitor(Corridor((2, 3)))
    try:
        algorithm(**{"policy": "MlpPolicy", "env": env, "device": "cpu", name: value}).learn(1)
    except (TypeError, ValueError) as error:
        assert re.search(rf"\b{name}\b", str(error))
