"""Without the RL Zoo: models trained there can be loaded, and a sentence says what to install."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import sys
sys.modules.update(rl_zoo3=None, optuna=None)
from sb3_reinforce import REINFORCE, FiniteDifference
for path, algorithm in zip(sys.argv[1:], (REINFORCE, FiniteDifference)):
    model = algorithm.load(path)
    print(model.learning_rate(0.5))
try:
    import sb3_reinforce.zoo
except ImportError as error:
    print(error)
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-W", "ignore", *arguments], capture_output=True, text=True)


def test_without_the_zoo_its_models_load_and_its_bridge_says_what_to_install(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    from zoo_commands import RUN, train

    names = ("reinforce", "finite_difference")
    for name in names:
        train(name, "-n", "64", "-f", str(tmp_path), "--eval-freq", "-1", "-params", "learning_rate:'lin_5E-1'")
    result = run("-c", SCRIPT, *(str(tmp_path / name / RUN / "CartPole-v1.zip") for name in names))
    assert result.stdout.splitlines()[-3:-1] == ["0.25", "0.25"]
    assert result.stdout.splitlines()[-1].startswith("sb3_reinforce.zoo needs the RL Zoo")
    assert "pip install 'sb3-reinforce[zoo]'" in result.stdout
