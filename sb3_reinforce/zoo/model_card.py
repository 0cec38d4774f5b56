"""Model cards: ``python -m sb3_reinforce.zoo.model_card --algo reinforce --env CartPole-v1 -f agents``."""

import argparse
import importlib
import re
import shlex
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3 import ALGOS, utils
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_reinforce.zoo.settings import ConfigurationError

# Options of ``train`` that change the result, and ``--exp-id`` of ``enjoy``, with their names in ``args.yml``
OPTIONS = {
    "--algo": "algo",
    "--env": "env",
    "-n": "n_timesteps",
    "-f": "log_folder",
    "--seed": "seed",
    "--conf-file": "conf_file",
    "-params": "hyperparams",
    "--env-kwargs": "env_kwargs",
    "--gym-packages": "gym_packages",
    "--trained-agent": "trained_agent",
    "--exp-id": "exp_id",
}
OF_ENJOY = ("algo", "env", "log_folder", "gym_packages")

CLASS = re.compile(r"<class ('[\w.]+')>")
INFINITY = re.compile(r"""('[^']*'|"[^"]*")|\binf\b""")

CARD = """---
library_name: stable-baselines3
tags: [{env}, deep-reinforcement-learning, reinforcement-learning, stable-baselines3]
---

# **{algorithm}** Agent playing **{env}**

Mean reward of {n_episodes} deterministic episodes, after training with seed {seed}: **{mean:.2f} ± {std:.2f}**

## Usage (with the RL Zoo)

```sh
{usage}
```

## Training

```sh
{command}
```

## Hyperparameters

```yaml
{settings}```
"""


def write_card(folder: str, name: str, env_id: str, n_episodes: int = 100, exp_id: int = 0) -> Path:
    """Evaluate a saved agent (run ``exp_id``, or the last if it is 0), and write ``README.md`` beside it."""
    env_name = utils.EnvironmentName(env_id)
    # Later runs do not change what the card shows
    exp_id = exp_id or utils.get_latest_run_id(str(Path(folder, name)), env_name)
    try:
        _, model, run = utils.get_model_path(exp_id, folder, name, env_name)
    except (AssertionError, ValueError) as error:
        raise ConfigurationError(f"{error}: pass another folder, algorithm, environment or --exp-id") from error
    saved = Path(run, env_name)
    arguments = yaml.unsafe_load((saved / "args.yml").read_text(encoding="utf-8"))
    for package in arguments["gym_packages"]:
        importlib.import_module(package)
    settings = dict(yaml.unsafe_load((saved / "config.yml").read_text(encoding="utf-8")))
    hyperparams, stats = utils.get_saved_hyperparams(str(saved), test_mode=True)
    env_kwargs = arguments["env_kwargs"] or settings.get("env_kwargs")
    # Not the seed of training, whose episodes the agent has seen
    seed = arguments["seed"] + 1000
    options = {"seed": seed, "should_render": False, "vec_env_cls": DummyVecEnv}
    env = utils.create_test_env(env_id, 10, stats, hyperparams=hyperparams, env_kwargs=env_kwargs, **options)
    agent = ALGOS[name].load(model, env=env)
    # load has seeded them as in training
    env.seed(seed)
    mean, std = evaluate_policy(agent, env, n_episodes)
    env.close()
    arguments["n_timesteps"] = max(arguments["n_timesteps"], 0) or int(settings["n_timesteps"])
    arguments["log_folder"] = folder
    if arguments["trial_id"] is not None:
        # The settings of the trial: others do not have its study
        arguments["hyperparams"] = settings
    path = Path(run, "README.md")
    card = CARD.format(
        algorithm=type(agent).__name__,
        command=zoo_command("train", arguments),
        env=env_id,
        mean=mean,
        n_episodes=n_episodes,
        seed=arguments["seed"],
        settings=yaml.dump(settings),
        std=std,
        usage=zoo_command("enjoy", {each: arguments[each] for each in OF_ENJOY} | {"exp_id": exp_id}),
    )
    path.write_text(card, encoding="utf-8")
    return path


def zoo_command(name: str, arguments: dict[str, Any]) -> str:
    """A command of the Zoo with the arguments that it has saved, as far as they change the result."""
    command = ["python", "-m", "sb3_reinforce.zoo", name]
    for option, argument in OPTIONS.items():
        value = arguments.get(argument)
        if isinstance(value, dict):
            value = [f"{key}:{as_python(part)}" for key, part in value.items()]
        words = value if isinstance(value, list) else [str(value)]
        if value not in (None, "", []):
            command += [option, *words]
    return shlex.join(command)


def as_python(value: Any) -> str:
    """A setting as the Zoo can evaluate it: a class by its path, and infinity as a call."""
    text = CLASS.sub(r"get_class_by_name(\1)", repr(value))
    return INFINITY.sub(lambda found: found[1] or "float('inf')", text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algo", required=True, choices=list(ALGOS))
    parser.add_argument("--env", required=True)
    parser.add_argument("-f", "--folder", required=True)
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run; 0 for the last")
    given = parser.parse_args()
    try:
        print(write_card(given.folder, given.algo, given.env, exp_id=given.exp_id))
    except ConfigurationError as error:
        parser.error(str(error))
