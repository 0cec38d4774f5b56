"""The comparison script: its rows are true, and no run is repeated."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import pandas
import pytest
import yaml
from zoo_commands import GAME

from sb3_reinforce.zoo import HYPERPARAMS, experiments

sys.path.append(str(Path(__file__).parents[2] / "examples" / "benchmarks"))
import compare

BENCHMARKS = Path(compare.__file__).parent


@pytest.fixture
def plots(monkeypatch):
    # It imports rliable, which takes seconds, in the processes that have these tests alone
    import compare_plots

    monkeypatch.setattr(compare_plots, "REPETITIONS", 20)
    return compare_plots


# PPO and TRPO are made as A2C is
@pytest.mark.parametrize("algorithm", ["reinforce", "finite_difference", "a2c", "ars"])
def test_rows_of_a_run(algorithm):
    run = compare.Run("CartPole-v1", algorithm, 0, 600)
    model, env, eval_env = compare.make(run)
    evaluations = compare.Evaluations(run, env, eval_env)
    stepped = 0

    class Counting(type(env)):  # type: ignore[misc]
        def step_wait(self):
            nonlocal stepped
            stepped += self.num_envs
            return super().step_wait()

    env.__class__ = Counting
    model.learn(run.budget, evaluations, log_interval=None)
    evaluations.evaluate("final", 5)
    rows = pandas.DataFrame(evaluations.rows)
    assert tuple(rows.columns) == compare.COLUMNS
    assert list(rows["evaluation"]) == ["training"] * (len(rows) - 1) + ["final"]
    assert rows["steps"].iloc[0] == 0 and rows["steps"].iloc[-1] == stepped >= run.budget
    assert rows["steps"].is_monotonic_increasing and rows["seconds"].is_monotonic_increasing
    # Returns of CartPole are lengths: the evaluation saw whole episodes, unscaled
    assert rows["return"].between(1, 500).all() and rows["episodes"].iloc[-1] == 5


def test_runs_share_no_policy_kwargs():
    first, second = (
        compare.make(compare.Run("MountainCarContinuous-v0", algorithm, 0, 600))[0] for algorithm in ("a2c", "ppo")
    )
    assert "optimizer_class" in first.policy_kwargs
    assert "optimizer_class" not in second.policy_kwargs


def test_peers_use_the_settings_of_another_version_and_searches_may_have_none():
    assert compare.settings_of("ppo", "Hopper-v5")["gamma"] == 0.999
    assert compare.settings_of("ars", "Hopper-v5")["alive_bonus_offset"] == -1
    assert compare.settings_of("finite_difference", "FrozenLake-v1") is None
    model = compare.make(compare.Run("FrozenLake-v1", "reinforce", 0, 600))[0]
    assert model.learn(64).num_timesteps >= 64


def test_algorithms_off_the_policy_have_the_noise_of_their_settings():
    assert compare.make(compare.Run("Pendulum-v1", "td3", 0, 300))[0].action_noise is not None


def test_settings_of_an_atari_game(monkeypatch):
    monkeypatch.setitem(gym.registry, "Game-v0", GAME)
    have_settings = {name for name in compare.ALGORITHMS if compare.settings_of(name, "Game-v0")}
    assert have_settings == {"reinforce", "a2c", "ppo"}


def test_models_have_the_settings_that_train_would_read(tmp_path, monkeypatch):
    default = {"policy": "MlpPolicy", "n_timesteps": 64, "temperature": "lin_1", "ent_coef": "lin_0.1"}
    (tmp_path / "reinforce.yml").write_text(json.dumps({"default": default}))
    monkeypatch.setattr(experiments, "HYPERPARAMS", tmp_path)
    model = compare.make(compare.Run("CartPole-v1", "reinforce", 0, 600))[0]
    assert model.temperature(0.25) == 0.25 and model.ent_coef(0.5) == 0.05
    pendulum = compare.Run("Pendulum-v1", "reinforce", 0, 600)
    assert compare.make(pendulum)[0].temperature == 1.0
    replaced = compare.make(pendulum, {"ent_coef": 0.5, "step": "natural"})[0]
    assert replaced.step == "natural" and replaced.ent_coef == 0.5


def test_a_finished_run_is_not_repeated_and_pictures_are_drawn(tmp_path, plots, monkeypatch, capsys):
    output = tmp_path / "made" / "results.csv"
    command = ["compare.py", "--tasks", "CartPole-v1", "--timesteps", "200", "--output", str(output)]
    command += ["--algorithms", "reinforce", "a2c", "--seeds", "0", "1", "--final-episodes", "10", "--processes", "1"]
    monkeypatch.setattr(sys, "argv", command)
    with mock.patch.object(signal, "signal"):
        compare.main()
        capsys.readouterr()
        compare.main()
        assert "Nothing to do" in capsys.readouterr().out
    results = pandas.read_csv(output)
    final = results[results["evaluation"] == "final"]
    runs = [("reinforce", 0), ("a2c", 0), ("reinforce", 1), ("a2c", 1)]
    assert list(zip(final["algorithm"], final["seed"], strict=True)) == runs
    monkeypatch.setattr(sys, "argv", ["compare_plots.py", str(output), "--output", str(tmp_path / "picture")])
    plots.main()
    assert {path.name for path in tmp_path.glob("*.png")} == {"picture_curves.png", "picture_summary.png"}
    median = final[final["algorithm"] == "reinforce"]["return"].median()
    shown = re.search(r"CartPole-v1 +200 +reinforce +2 +(\S+)", capsys.readouterr().out)
    assert shown and float(shown[1]) == pytest.approx(median)


@pytest.mark.slow
def test_sigterm_ends_the_processes_too(tmp_path):
    output = tmp_path / "results.csv"
    arguments = ["--tasks", "CartPole-v1", "--algorithms", "reinforce", "--timesteps", "10000000", "--processes", "1"]
    arguments += ["--output", str(output)]
    script = subprocess.Popen([sys.executable, BENCHMARKS / "compare.py", *arguments], start_new_session=True)
    children = Path(f"/proc/{script.pid}/task/{script.pid}/children")
    deadline = time.monotonic() + 60
    # The resource tracker of multiprocessing, and a worker
    while not (output.exists() and len(children.read_text().split()) > 1):
        assert script.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    script.terminate()
    script.wait(60)
    deadline = time.monotonic() + 30
    with pytest.raises(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(script.pid, 0)
            time.sleep(0.1)
        os.killpg(script.pid, signal.SIGKILL)


def test_a_task_that_is_not_registered_is_named_at_once(tmp_path, capsys):
    with mock.patch.object(sys, "argv", ["compare.py", "--tasks", "Nope-v5", "--output", str(tmp_path / "r.csv")]):
        with pytest.raises(SystemExit):
            compare.main()
    assert "--tasks: Nope-v5 not registered" in capsys.readouterr().err and not any(tmp_path.iterdir())


def test_a_run_that_is_there_twice_is_refused(plots, tmp_path, monkeypatch, capsys):
    row = "CartPole-v1,reinforce,0,600,final,600,1.0,1.0,9.0,1.0,5"
    (tmp_path / "rows.csv").write_text(f"{','.join(compare.COLUMNS)}\n{row}\n")
    path = str(tmp_path / "rows.csv")
    monkeypatch.setattr(sys, "argv", ["compare_plots.py", path, path, "--output", str(tmp_path / "picture")])
    with pytest.raises(SystemExit):
        plots.main()
    assert "'seed': 0, 'budget': 600} twice" in capsys.readouterr().err


def test_a_curve_is_the_interquartile_mean_between_the_evaluations(plots):
    returns = {0: (0, -50), 1: (0, 8), 2: (0, 12), 3: (0, 90)}
    rows = [(seed, steps, value) for seed, each in returns.items() for steps, value in zip((0, 100), each, strict=True)]
    runs = pandas.DataFrame(rows, columns=["seed", "steps", "return"])
    points, iqm, low, high = plots.curve(runs, "steps", 50)
    np.testing.assert_allclose(iqm, points / 100 * 10)
    assert (low <= iqm).all() and (iqm <= high).all() and low[-1] < 0 < high[-1]


@pytest.mark.parametrize(
    ("missing", "sentence", "drawn"),
    [
        ([("reinforce", "CartPole-v1"), ("reinforce", "Reacher-v5")], "No probability of improvement", {"a2c", "ppo"}),
        ([("reinforce", "Reacher-v5")], "REINFORCE (seed 0), REINFORCE (seed 1)", {"a2c", "ppo"}),
        ([("a2c", "Reacher-v5")], "A2C (seed 0), A2C (seed 1)", {"reinforce", "ppo"}),
    ],
)
def test_a_summary_says_what_it_leaves_out(missing, sentence, drawn, plots, capsys):
    rows = [
        {"task": task, "budget": 9, "algorithm": name, "seed": seed, "evaluation": "final", "return": -5.0 * seed}
        for name in ("reinforce", "a2c", "ppo")
        for task in ("CartPole-v1", "Reacher-v5")
        for seed in (0, 1)
        if (name, task) not in missing
    ]
    scores = plots.final_scores(pandas.DataFrame(rows))
    plots.draw_summary(scores)
    assert set(scores) == drawn and sentence in capsys.readouterr().out
    assert plots.plt.gcf().axes[2].axison == ("reinforce" in drawn)
    plots.plt.close("all")


@pytest.mark.parametrize("name", ["reinforce", "reinforce_lstm"])
def test_every_task_with_settings_has_a_reference(name, plots):
    published = yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())
    missing = published.keys() - {"default", "atari", "train_env_kwargs"} - plots.REFERENCES.keys()
    assert not missing, f"REFERENCES of compare_plots.py has no random and no good return of {missing}"
