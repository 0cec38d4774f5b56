"""What is left without the RL Zoo: the algorithms, and a sentence."""

import subprocess
import sys

SCRIPT = """
import sys
sys.modules.update(rl_zoo3=None, optuna=None)
from sb3_reinforce import REINFORCE, FiniteDifference
try:
    import sb3_reinforce.zoo
except ImportError as error:
    print(error)
"""


def test_the_package_imports_without_the_zoo_and_its_zoo_says_what_to_install() -> None:
    result = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert result.stdout.startswith("sb3_reinforce.zoo needs the RL Zoo")
    assert "pip install 'sb3-reinforce[zoo]'" in result.stdout
