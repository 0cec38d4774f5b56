"""Without the RL Zoo: models trained there can be loaded, and a sentence says what to install."""

import subprocess
import sys
from pathlib import Path

import pytest

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
SCRIPT = """
import importlib, sys
sys.modules.update(rl_zoo3=None, optuna=None)
from sb3_reinforce import REINFORCE, FiniteDifference
for path, algorithm in zip(sys.argv[2:], (REINFORCE, FiniteDifference)):
    model = algorithm.load(path)
    print(model.learning_rate(0.5))
try:
    import sb3_reinforce.zoo
except ImportError as error:
    print(error)
module, _, function = sys.argv[1].partition(":")
getattr(importlib.import_module(module), function)()
"""


def test_without_the_zoo_its_models_load_and_its_bridge_says_what_to_install(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    from zoo_commands import RUN, train

    names = ("reinforce", "finite_difference")
    for name in names:
        train(name, "-n", "64", "-f", str(tmp_path), "--eval-freq", "-1", "-params", "learning_rate:'lin_5E-1'")
    console_script = PYPROJECT.read_text().partition('sb3-reinforce-zoo = "')[2].partition('"')[0]
    models = [str(tmp_path / name / RUN / "CartPole-v1.zip") for name in names]
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, console_script, *models]
    result = subprocess.run(command, capture_output=True, text=True)
    *rates, sentence = result.stdout.splitlines()[-3:]
    assert rates == ["0.25", "0.25"]
    assert sentence.startswith("sb3_reinforce.zoo needs the RL Zoo")
    assert "pip install 'sb3-reinforce[zoo]'" in sentence and "pip install -e '.[zoo]'" in sentence
    assert result.stderr == f"sb3-reinforce-zoo: error: {sentence}\n" and result.returncode == 2
