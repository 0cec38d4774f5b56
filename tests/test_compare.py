"""The comparison script: what its rows say is what happened, and a run is made once."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("rl_zoo3")
pandas = pytest.importorskip("pandas")

BENCHMARKS = Path(__file__).parent.parent / "examples" / "benchmarks"
# The Zoo and what it calls warn of their own affairs
pytestmark = pytest.mark.filterwarnings("ignore")


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


compare = load("compare")


@pytest.mark.parametrize("algorithm", compare.ALGORITHMS)
def test_rows_of_a_run(algorithm: str) -> None:
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
    evaluations.evaluate("final", 20)
    rows = pandas.DataFrame(evaluations.rows)
    assert tuple(rows.columns) == compare.COLUMNS
    assert list(rows["evaluation"]) == ["training"] * (len(rows) - 1) + ["final"]
    assert rows["steps"].iloc[0] == 0 and rows["steps"].iloc[-1] == stepped >= run.budget
    assert rows["steps"].is_monotonic_increasing and rows["seconds"].is_monotonic_increasing
    # Returns of CartPole are lengths: the evaluation saw whole episodes, unscaled
    assert rows["return"].between(1, 500).all() and rows["episodes"].iloc[-1] == 20


def test_runs_share_no_policy_kwargs() -> None:
    first, second = (
        compare.make(compare.Run("MountainCarContinuous-v0", algorithm, 0, 600))[0] for algorithm in ("a2c", "ppo")
    )
    assert "optimizer_class" in first.policy_kwargs
    assert "optimizer_class" not in second.policy_kwargs


def test_settings_of_another_version_and_of_tasks_no_search_has_any_for() -> None:
    assert compare.settings_of("ppo", "Hopper-v5")["gamma"] == 0.999
    assert compare.settings_of("ars", "Hopper-v5")["alive_bonus_offset"] == -1
    assert compare.settings_of("finite_difference", "Taxi-v3") is None
    assert compare.settings_of("reinforce", "Taxi-v3")["policy"] == "MlpPolicy"


def test_a_finished_run_is_not_repeated_and_pictures_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "results.csv"
    command = [sys.executable, str(BENCHMARKS / "compare.py"), "--tasks", "CartPole-v1", "--timesteps", "200"]
    command += ["--algorithms", "reinforce", "a2c", "--seeds", "0", "1", "--final-episodes", "10", "--processes", "1"]
    command += ["--output", str(output)]
    subprocess.run(command, check=True)
    results = pandas.read_csv(output)
    final = results[results["evaluation"] == "final"]
    runs = [("reinforce", 0), ("a2c", 0), ("reinforce", 1), ("a2c", 1)]
    assert list(zip(final["algorithm"], final["seed"], strict=True)) == runs
    assert "Nothing to do" in subprocess.run(command, capture_output=True, text=True).stderr
    pytest.importorskip("rliable")
    monkeypatch.setattr(sys, "argv", ["compare_plots.py", str(output), "--output", str(tmp_path / "picture")])
    plots = load("compare_plots")
    monkeypatch.setattr(plots, "REPETITIONS", 20)
    plots.main()
    assert {path.name for path in tmp_path.glob("*.png")} == {"picture_curves.png", "picture_summary.png"}
    median = final[final["algorithm"] == "reinforce"]["return"].median()
    assert f"| CartPole-v1 (200) | REINFORCE | 2 | {median:.1f} (" in capsys.readouterr().out
