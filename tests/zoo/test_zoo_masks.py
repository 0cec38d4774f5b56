"""A wrapper and a policy in the settings are all that masks need in the Zoo, for its own algorithms too."""

import sys

import gymnasium as gym
import pytest
from zoo_commands import zoo

STRICT = """
import gymnasium as gym
from sb3_contrib.common.envs import InvalidActionEnvDiscrete

class Strict(InvalidActionEnvDiscrete):
    def step(self, action):
        assert self.action_masks()[action], "forbidden"
        return super().step(action)

gym.register("Strict-v0", Strict, kwargs={"dim": 8, "n_invalid_actions": 5})
"""
SETTINGS = """
Strict-v0:
  n_timesteps: 256
  policy: {}
  env_wrapper: sb3_reinforce.ActionMaskObservation
  normalize: "dict(norm_obs=False)"
"""


@pytest.mark.parametrize(("name", "policy"), [("reinforce", "MaskedPolicy"), ("a2c", "sb3_reinforce.MaskedPolicy")])
def test_masks_in_the_settings(name, policy, tmp_path, monkeypatch, capsys):
    (tmp_path / "strict.py").write_text(STRICT)
    (tmp_path / "settings.yml").write_text(SETTINGS.format(policy))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "strict", raising=False)
    common = ("--algo", name, "--env", "Strict-v0", "--gym-packages", "strict", "-f", str(tmp_path))
    zoo("train", *common, "--conf-file", str(tmp_path / "settings.yml"), "--eval-freq", "128", "--eval-episodes", "1")
    zoo("enjoy", *common, "--no-render", "-n", "200")
    gym.registry.pop("Strict-v0")
    out = capsys.readouterr().out
    assert "Mean reward: " in out and "Loading running average" in out
