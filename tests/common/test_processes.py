"""W processes of n environments are one process with W·n: the same parameters, steps and logs."""

from functools import partial

import enumeration
import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor
from gymnasium import spaces
from models import KINDS, Scaled, make, plain
from processes import ActAsRecorded, RecordRollouts, Replay, in_processes, logged
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import FiniteDifference
from sb3_reinforce.common.moments import seen_since
from sb3_reinforce.common.tensors import flatten
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.policies.evaluation import temperature_of
from sb3_reinforce.recurrent import RecurrentREINFORCE
from sb3_reinforce.sampling.collection import ROWS, Columns
from sb3_reinforce.sampling.columns import join

SEARCHES = {
    "central": {"estimator": "central", "n_delta": 3},
    "two utilities": {"estimator": "forward", "n_delta": 5, "perturbation": "coordinate"},
    "regression": {"estimator": "regression", "n_delta": 40, "n_eval_episodes": 2},
    "frozen": {"estimator": "central", "n_delta": 3},
}


def search(rank, n_envs, n_updates, names):
    answers = {}
    for name in names:
        env = make_vec_env("CartPole-v1", n_envs, env_kwargs={"max_episode_steps": 50})
        model = make("search", env, seed=5, **{**SEARCHES[name], "common_random_numbers": True})
        if name == "frozen" and rank == 0:
            # As a callback does, which is called in process 0 only
            model.policy.action_net.requires_grad_(False)
        model.learn(10**6, lambda values, _, model=model: model._n_updates < n_updates)
        answers[name] = plain(model.theta), model._n_updates, len(model.ep_info_buffer)
    return answers


@pytest.mark.parametrize(
    ("n_updates", "names", "sizes"),
    [(2, SEARCHES, (2,)), pytest.param(50, ("central", "two utilities"), (2, 4), marks=pytest.mark.slow)],
)
def test_finite_difference_has_the_same_parameters_bit_for_bit(n_updates, names, sizes, tmp_path):
    alone = search(0, 4, n_updates, names)
    for size in sizes:
        task = partial(search, n_envs=4 // size, n_updates=n_updates, names=names)
        first, *others = in_processes(size, task, tmp_path)
        assert first == alone
        assert all(other[name][:2] == first[name][:2] for other in others for name in names)


EXTENTS = {"steps": {"n_steps": 12}, "episodes": {"n_steps": None, "n_episodes": 7}}
MEMORY = {"baseline": "value", "policy_kwargs": {"lstm_hidden_size": 4, "net_arch": [4]}}
SHARED_EXTRACTOR = {"net_arch": [4], "features_extractor_class": Scaled}
ROLLOUTS = {f"{name} {extent}": {"baseline": name, **EXTENTS[extent]} for name in BASELINES for extent in EXTENTS} | {
    "shared extractor": {"policy_kwargs": SHARED_EXTRACTOR},
    "total return": {"baseline": "mean", "reward_to_go": False, **EXTENTS["steps"]},
    "normalized": {"normalize_advantage": True, "normalize_by": "episodes", **EXTENTS["episodes"]},
    "schedules": {"temperature": lambda left: 1 + left, "learning_rate": lambda left: 0.01 * left},
    "fewer episodes than processes": {"n_steps": None, "n_episodes": 1},
    "recurrent episodes": {"n_episodes": 7, **MEMORY},
    "recurrent steps": {"n_steps": 5, **MEMORY},
}
WRAPPERS = {"normalized": VecNormalize, "schedules": VecNormalize}


def corridors(n_envs, lengths=(2, 3, 4), reward=lambda t, action: float(action) - t, **kwargs):
    return make_vec_env(lambda: Corridor(lengths, reward, **kwargs), n_envs)


def build(name, env):
    kwargs = {"seed": 1, "device": "cpu", **ROLLOUTS[name]}
    if name.startswith("recurrent"):
        return RecurrentREINFORCE("MlpLstmPolicy", env, **kwargs)
    return make("steps", env if isinstance(env, Replay) else WRAPPERS.get(name, lambda env: env)(env), **kwargs)


def learn_all(rank):
    """The rollouts and last states of all models, in this process."""
    answers = {}
    for name in ROLLOUTS:
        model = build(name, corridors(2, truncate=True))
        callback = RecordRollouts()
        model.learn(60, callback)
        answers[name] = model.get_parameters(), logged(model), model.num_timesteps, callback.rollouts
    return answers


@pytest.fixture(scope="module")
def of_two_processes(tmp_path_factory):
    return in_processes(2, learn_all, tmp_path_factory.mktemp("group"))


@pytest.mark.filterwarnings("ignore:Episodes that n_steps cuts")
@pytest.mark.parametrize("name", ROLLOUTS)
def test_reinforce_is_one_process_that_collects_the_same_rollouts(name, of_two_processes):
    parameters, log, num_timesteps, rollouts = of_two_processes[0][name]
    model = build(name, corridors(2, truncate=True))
    model = build(name, Replay(model, rollouts, starts_over=model.n_episodes is not None))
    callback = ActAsRecorded(rollouts)
    # Processes that have played their episodes make fewer steps than the environments of one process
    model.learn(60 if model.n_steps else 10**6, callback)
    if name == "recurrent steps":
        # The states that are carried on have been computed for two environments at once, and for four
        for key, expected in parameters["policy"].items():
            th.testing.assert_close(model.policy.state_dict()[key], expected, rtol=0, atol=1e-6)
    else:
        assert plain(model.get_parameters()) == plain(parameters) and logged(model) == log
        assert [rollout.log for rollout in callback.rollouts] == [rollout.log for rollout in rollouts]
    assert len(rollouts) > 1 and 60 <= num_timesteps <= model.num_timesteps
    # Callbacks of process 0 only, and its policy in both
    assert not of_two_processes[1][name][-1]
    assert plain(of_two_processes[1][name][0]["policy"]) == plain(parameters["policy"])


@pytest.mark.parametrize("baseline", ["none", "leave_one_out"])
def test_the_expected_gradient_of_two_processes_is_exact(baseline, monkeypatch):
    """Each process plays one episode; the shorter one is padded."""
    fill = enumeration.fill

    def fill_in_parts(model, batch):
        parts = []
        for episode in batch:
            buffer, dones = fill(model, [episode])
            columns = Columns(dones, {}, buffer.observations[-1], np.ones(1, dtype=int))
            parts.append((columns, {name: getattr(buffer, name) for name in ROWS}))
        return buffer, join(buffer, parts).dones

    model = enumeration.make_model(ragged=True, baseline=baseline)
    monkeypatch.setattr(enumeration, "fill", fill_in_parts)
    enumeration.assert_equal(enumeration.expected_gradient(model), enumeration.gradient_of_return(model))


def of_the_union(rank, n_envs=2):
    """In a task whose observations and rewards do not depend on the actions, and in one that is not seeded."""
    inner = VecNormalize(corridors(n_envs, (3,), lambda t, action: float(t)), norm_obs=False)
    env = VecNormalize(inner, norm_reward=False)
    model = make("steps", env, seed=10, n_steps=3)
    model.learn(60)
    model.learn(60, reset_num_timesteps=False)
    moments = [(rms.mean, rms.var, rms.count) for rms in (env.obs_rms, inner.ret_rms)]
    th.manual_seed(0)
    unseeded = make("steps", corridors(n_envs))
    unseeded.learn(16)
    seeds = env.get_attr("np_random_seed"), unseeded.env.get_attr("np_random_seed")
    wait_fraction = model.logger.name_to_value.get("time/wait_fraction")
    return model.num_timesteps, len(model.ep_info_buffer), moments, *seeds, th.rand(1).item(), wait_fraction


def test_seeds_steps_episodes_and_moments_are_those_of_one_process(tmp_path):
    n_steps, n_episodes, moments, seeds, *_ = of_the_union(0, 4)
    first, second = in_processes(2, of_the_union, tmp_path)
    assert first[0] == second[0] == n_steps == 120
    assert first[1] == n_episodes == 40
    assert first[3] + second[3] == seeds == [10, 11, 12, 13]
    for expected, found, same in zip(moments, first[2], second[2], strict=True):
        for value, one, other in zip(expected, found, same, strict=True):
            assert np.allclose(one, value, rtol=1e-9, atol=0) and np.array_equal(one, other)
    assert {*first[4]}.isdisjoint(second[4]) and first[5] != second[5]
    assert 0 < first[6] < 1


def test_moments_seen_since_are_exact_far_from_zero():
    data = np.random.default_rng(0).normal(1e4, 1.0, (5000, 3))
    after = RunningMeanStd(shape=(3,))
    after.update(data[:4000])
    before = after.copy()
    after.update(data[4000:])
    seen = seen_since(before, after)
    assert seen.count == 1000
    assert np.allclose(seen.mean, data[4000:].mean(0), rtol=1e-9)
    assert np.allclose(seen.var, data[4000:].var(0), rtol=1e-6)


DIFFERENT = {
    "gamma": "gamma=0.9",
    "normalize_by": "normalize_by='steps'",
    "n_envs": "n_envs=1",
    "spaces": "Box(-1.0",
    "policy": "Tanh",
    "VecNormalize": "VecNormalize=[]",
}


def differ(rank, name):
    kwargs = {
        "gamma": {"gamma": 0.9 + 0.05 * rank},
        "normalize_by": {"normalize_by": ["steps", "episodes"][rank]},
        "policy": {"policy_kwargs": {"activation_fn": [th.nn.Tanh, th.nn.ReLU][rank]}},
    }.get(name, {})
    env = corridors(1 + rank if name == "n_envs" else 1)
    if name == "spaces":
        env = make_vec_env(lambda: Corridor(action_space=spaces.Box(-1, 1 + rank, (1,))), 1)
    model = make("steps", VecNormalize(env) if name == "VecNormalize" and rank else env, **kwargs)
    model.learn(10)


@pytest.mark.parametrize("name", DIFFERENT)
def test_processes_with_other_arguments_are_refused(name, tmp_path):
    first, second = in_processes(2, partial(differ, name=name), tmp_path)
    assert isinstance(first, ValueError) and "must be started with the same arguments" in str(first)
    assert str(first) == str(second) and DIFFERENT[name] in str(second) and "process 1 has" in str(second)


def test_verbose_and_tensorboard_log_may_differ(tmp_path):
    def learn(rank):
        folder = str(tmp_path) if rank == 0 else None
        model = make("steps", corridors(1), verbose=1 - rank, tensorboard_log=folder).learn(32)
        return model.num_timesteps, model.verbose, model.tensorboard_log

    assert in_processes(2, learn, tmp_path) == [(32, 1, str(tmp_path)), (32, 0, None)]


def test_all_processes_end_with_the_last_temperature(tmp_path):
    def learn(rank):
        return temperature_of(make("steps", corridors(1), temperature=lambda left: 1 + left).learn(16).policy)

    assert in_processes(2, learn, tmp_path) == [1.0, 1.0]


def actions_of_all(rank, path):
    """With restored generators, with the same seed in all, and after a callback has changed policy or temperature."""
    restored = KINDS["steps"][0].load(path, corridors(1), restore_random_state=True)
    restored.learn(1)
    seeded = make("steps", corridors(1), n_steps=32)
    th.manual_seed(0)
    seeded.learn(1)
    changed = make("steps", corridors(1), n_steps=32)
    always_1 = th.tensor([-50.0, 50.0])
    changed.learn(128, Record(lambda model: model.policy.action_net.bias.data.copy_(always_1)))
    # From probabilities of 0.27 and 0.73 on, in the only rollout
    cooled = make("steps", corridors(1), n_steps=32)
    cooled.policy.action_net.bias.data.copy_(always_1 / 100)
    # NumPy's numbers reach the other processes too
    cooled.learn(1, Record(lambda model: setattr(model, "temperature", np.float32(1e-3)), "rollout_start"))
    return [model.rollout_buffer.actions[..., 0].T for model in (restored, seeded, changed, cooled)]


def test_processes_draw_other_actions_and_take_over_what_a_callback_changes(tmp_path):
    make("steps", corridors(1), n_steps=32, seed=0).save(tmp_path / "model")
    answers, _ = in_processes(2, partial(actions_of_all, path=tmp_path / "model"), tmp_path)
    restored, seeded, changed, cooled = answers
    assert (restored[0] != restored[1]).any() and (seeded[0] != seeded[1]).any()
    assert (changed == 1).all() and (cooled == 1).all()


def observations_of_all(rank):
    """Of whole episodes after the user has stepped the environments."""
    model = make("episodes", corridors(1, (3,))).learn(1)
    model.env.step(np.zeros(1, dtype=int))
    model.learn(1, reset_num_timesteps=False)
    return model.rollout_buffer.observations.argmax(-1).T.tolist()


def test_after_common_starts_the_environments_of_all_processes_are_independent(tmp_path):
    def learn(rank):
        env = make_vec_env("Pendulum-v1", 4, seed=0)
        FiniteDifference("LinearPolicy", env, seed=0, device="cpu").learn(1)
        return env.reset()

    first, second = in_processes(2, learn, tmp_path)
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 8


def test_whole_episodes_begin_with_a_reset_in_all_processes(tmp_path):
    observations, _ = in_processes(2, observations_of_all, tmp_path)
    assert observations == [[0, 1, 2], [0, 1, 2]]


def values_with_a_hook(rank):
    """V in process 0, whose policy a callback has given a hook, and what it should be."""
    model = make("steps", corridors(2), n_steps=3, learning_rate=0.0)
    model.learn(1, Record(lambda model: model.policy.register_forward_hook(lambda *_: None), "rollout_start"))
    rollout = model.rollout
    if rank == 0:
        return rollout.values.flatten().tolist(), model.policy.predict_values(flatten(rollout.observations)).tolist()


def test_values_of_all_columns_are_known_where_only_process_0_calls_forward(tmp_path):
    (values, expected), _ = in_processes(2, values_with_a_hook, tmp_path)
    assert np.allclose(values, np.ravel(expected))


def returns_in_window(rank):
    model = make("steps", corridors(2, (3,), lambda t, action: float(rank)), n_steps=3, stats_window_size=2)
    model.learn(24)
    return sorted(episode["r"] for episode in model.ep_info_buffer)


def test_the_window_of_the_log_has_episodes_of_all_processes(tmp_path):
    assert in_processes(2, returns_in_window, tmp_path)[0] == [0.0, 3.0]


def norm_of_change(rank):
    """Of θ, by the differences of candidates that are all θ but for rounding."""
    env = VecNormalize(make_vec_env("Pendulum-v1", 1), norm_reward=False)
    model = make("search", env, n_delta=4, delta_std=1e-30, common_random_numbers=True, seed=0)
    before = model.theta
    model.learn(1)
    return float((model.theta - before).norm())


def test_candidates_of_all_processes_are_compared_on_one_scale(tmp_path):
    of_process_0, _ = in_processes(2, norm_of_change, tmp_path)
    assert of_process_0 == 0


def test_a_default_is_chosen_again_for_another_number_of_processes(tmp_path):
    path = tmp_path / "model"
    make("episodes", corridors(12), n_episodes=None).save(path)

    def load(rank):
        return KINDS["episodes"][0].load(path, device="cpu").n_episodes

    assert load(0) == 16
    assert in_processes(2, load, tmp_path) == [24, 24]


@pytest.mark.parametrize(("seed", "expected"), [(5, 7), (2**31, 2**31 + 2), (2**32 - 1, 1)])
def test_the_environments_of_the_second_process_have_the_following_seeds(seed, expected, monkeypatch):
    """NumPy takes seeds up to 2³² − 1."""
    for name, value in {"TORCHELASTIC_RUN_ID": "1", "RANK": "1", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    env = make_vec_env(Corridor, 2)
    monkeypatch.setattr(env, "seed", lambda seed=None: seeds.append(seed))
    seeds = []
    make("steps", env, seed=seed)
    assert seeds == [expected]
