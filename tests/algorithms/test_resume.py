"""Saving, loading into a fresh process and going on is bit for bit never having stopped."""

import hashlib
import multiprocessing
import pickle
import random

import numpy as np
import torch as th
from callbacks import At
from models import KINDS, both, make, plain
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

TOTAL = 1600


def draws():
    return random.random(), np.random.random(), float(th.rand(()))


def environment(seed):
    return VecNormalize(make_vec_env("Pendulum-v1", 2, seed=seed))


def finish(model, env):
    env.seed(7)
    model.set_env(env)
    model.learn(TOTAL - model.num_timesteps, reset_num_timesteps=False)
    return digest(model, env)


def digest(model, env):
    """Everything that must not differ."""
    state = {
        "counts": (model.num_timesteps, model._n_updates, model._current_progress_remaining),
        "episodes": [(episode["r"], episode["l"]) for episode in model.ep_info_buffer],
        "statistics": plain([[rms.mean, rms.var, rms.count] for rms in (env.obs_rms, env.ret_rms)]),
        "generators": (hashlib.sha256(th.get_rng_state().numpy().tobytes()).hexdigest(), draws()),
    }
    parameters = model.get_parameters().items()
    return state | {name: hashlib.sha256(pickle.dumps(plain(part))).hexdigest() for name, part in parameters}


def go_on(folder):
    """What a fresh process does."""
    th.set_num_threads(1)
    ends = {}
    # In reverse: what an earlier model leaves in the process must not matter
    for kind, (algorithm, _) in reversed(KINDS.items()):
        env = VecNormalize.load(str(folder / f"{kind}.pkl"), make_vec_env("Pendulum-v1", 2, seed=11))
        model = algorithm.load(folder / kind, env=env, device="cpu", restore_random_state=True)
        ends[kind] = finish(model, env)
    (folder / "ends.pkl").write_bytes(pickle.dumps(ends))


def half_trained(kind, folder):
    """A model that has been saved after half of its training, and its environments."""
    schedules = {"learning_rate": LinearSchedule(1e-3, 0, 1)}
    if kind == "steps":
        schedules["ent_coef"] = LinearSchedule(0.01, 0, 1)
    if kind == "search":
        schedules |= {"deterministic": False, "delta_std": LinearSchedule(0.1, 0.01, 1)}
    env = environment(3)
    model = make(kind, env, seed=3, **schedules)
    # With two environments, in the first rollout of the second half
    model.learn(TOTAL, At(TOTAL // 4 + 1))
    assert TOTAL // 2 < model.num_timesteps < TOTAL and model._n_updates > 0
    assert kind == "search" or env.ret_rms.count > TOTAL // 2
    model.save(folder / kind)
    env.save(folder / f"{kind}.pkl")
    return model, env


def test_a_fresh_process_ends_where_this_one_does(tmp_path):
    expected = {kind: finish(*half_trained(kind, tmp_path)) for kind in KINDS}
    # Its parent, the server, has imported PyTorch and nothing more
    process = multiprocessing.get_context("forkserver").Process(target=go_on, args=(tmp_path,))
    process.start()
    process.join()
    assert process.exitcode == 0
    found = pickle.loads((tmp_path / "ends.pkl").read_bytes())
    for kind, end in expected.items():
        assert found[kind] == end, kind


def test_the_generators_are_restored_on_request(tmp_path):
    model = make("steps")
    model.save(tmp_path / "model")
    expected = draws()
    KINDS["steps"][0].load(tmp_path / "model", device="cpu", restore_random_state=True)
    assert draws() == expected
    before = random.getstate(), np.random.get_state()[1].tolist()
    KINDS["steps"][0].load(tmp_path / "model", device="cpu")
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before


def test_generators_of_other_devices_are_left_alone(tmp_path, monkeypatch):
    """A model on the CPU must not wake the GPUs of the machine."""
    asked = []
    for name in ("get_rng_state", "get_rng_state_all", "set_rng_state", "set_rng_state_all"):
        monkeypatch.setattr(th.cuda, name, lambda *args, name=name: asked.append(name))
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 2)
    make("steps").save(tmp_path / "model")
    KINDS["steps"][0].load(tmp_path / "model", device="cpu", restore_random_state=True)
    assert asked == []


@both
def test_a_new_seed_at_load_draws_other_numbers(kind, tmp_path):
    kwargs = {"common_random_numbers": True} if kind == "search" else {}
    make(kind, make_vec_env("CartPole-v1", 2), seed=0, **kwargs).learn(100).save(tmp_path / "model")
    ends = []
    for kwargs in ({"seed": 1}, {"seed": 2}, {"custom_objects": {"seed": 2}}):
        model = KINDS[kind][0].load(tmp_path / "model", env=make_vec_env("CartPole-v1", 2), device="cpu", **kwargs)
        ends.append(plain(model.learn(200).get_parameters()))
    assert ends[1] == ends[2] != ends[0]


def test_a_policy_acts_alike_before_a_save_and_after_a_load(tmp_path):
    model = make("steps", temperature=lambda progress: 0.5 + progress, seed=0).learn(64)
    model.save(tmp_path / "model")
    loaded, obs = type(model).load(tmp_path / "model"), th.randn(64, 4)
    assert th.equal(*(each.policy.get_distribution(obs).distribution.probs for each in (model, loaded)))
    assert np.array_equal(*(each.predict(obs.numpy(), deterministic=True)[0] for each in (model, loaded)))
    assert model.rollout is not None and loaded.rollout is None


def test_whole_episodes_go_on_from_one_reset(tmp_path):
    """So the seeds that the user sets are those of the first episodes."""
    env, other = (make_vec_env("Pendulum-v1", 2, seed=0) for _ in range(2))
    model = make("episodes", env, seed=0).learn(1)
    model.save(tmp_path / "model")
    loaded = KINDS["episodes"][0].load(tmp_path / "model", other, device="cpu", restore_random_state=True)
    first = []
    for each in (loaded, model):
        each.env.seed(7)
        random_state = th.get_rng_state()
        each.learn(1, reset_num_timesteps=False)
        first.append(each.rollout_buffer.observations[0].tolist())
        th.set_rng_state(random_state)
    # Nor has a model without steps used the environments since
    new = make("episodes", env, seed=0).learn(0)
    env.seed(7)
    new.learn(1, reset_num_timesteps=False)
    first.append(new.rollout_buffer.observations[0].tolist())
    env.seed(7)
    assert first == [env.reset().tolist()] * 3
