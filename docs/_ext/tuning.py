"""The tables of the shipped settings, and of the seeds on which they were chosen."""

import inspect

import yaml
from cells import NONE, RESULTS, counted, markdown, number, read, short, spread
from tables import compared

from sb3_reinforce import REINFORCE

SETTINGS = RESULTS.parents[2] / "sb3_reinforce" / "zoo" / "hyperparams" / "reinforce.yml"
DEFAULTS = {name: str(each.default) for name, each in inspect.signature(REINFORCE).parameters.items()}
DEFAULTS |= {"policy": "MlpPolicy", "normalize": "False", "train_env_kwargs": "{}"}
# What the table of settings has a column for, and a list of wrappers
NOT_LISTED = {"step", "target_kl", "learning_rate", "n_envs", "n_steps", "gamma", "gae_lambda", "n_timesteps", "policy"}
NOT_LISTED |= {"env_wrapper"}


def shipped(task: str) -> dict[str, str]:
    """The shipped settings of a task, written as in ``tuning.csv``."""
    published = yaml.safe_load(SETTINGS.read_text(encoding="utf-8"))
    settings = {**published[task], "train_env_kwargs": published["train_env_kwargs"].get(task, {})}
    return DEFAULTS | {key: str(value).replace(" ", "") for key, value in settings.items()}


def settings() -> str:
    """The shipped settings of each task; the last column has what else differs from ``default``."""
    base = shipped("default")
    lines = []
    for task in yaml.safe_load(SETTINGS.read_text(encoding="utf-8")):
        if task in ("train_env_kwargs", "default", "atari"):
            continue
        ours = shipped(task)
        changed = [key for key, value in ours.items() if key not in NOT_LISTED and base.get(key) != value]
        lines.append(
            [
                f"{task} ({short(int(float(ours['n_timesteps'])))})",
                ours["step"],
                NONE if ours["step"] == "optimizer" else ours["target_kl"],
                ours["learning_rate"],
                f"{ours['n_envs']} × {ours['n_steps']}",
                ours["gamma"],
                ours["gae_lambda"],
                ", ".join(f"`{key}={ours[key]}`" for key in changed) or NONE,
            ]
        )
    header = ["task (steps)", "`step`", "`target_kl`", "`learning_rate`", "environments × `n_steps`", "`gamma`"]
    return markdown([*header, "`gae_lambda`", "also"], lines)


def is_shipped(task: str, text: str) -> bool:
    """Whether a line of settings is the shipped one."""
    ours = shipped(task)
    theirs = DEFAULTS | dict(each.split("=", 1) for each in text.split())
    return all(ours.get(key) == value for key, value in theirs.items())


def chosen_on() -> str:
    """The ten seeds of the choice beside the reported ones, with the shipped settings; a seed's later run counts."""
    rows = read("tuning").query("algorithm == 'reinforce' and 100 <= seed < 110")
    reported = compared().query("algorithm == 'reinforce'").groupby(["task", "budget"])
    lines = []
    for (task, budget, text), same in rows.groupby(["task", "budget", "settings"]):
        returns = same.groupby("seed")["return"].last()
        if len(returns) == 10 and is_shipped(str(task), text):
            shown = counted(reported.get_group((task, budget))["return"])
            worst = number(returns.nsmallest(3).mean())
            lines.append([f"{task} ({short(int(budget))})", spread(returns), worst, shown])
    return markdown(["task (steps)", "seeds 100 to 109", "mean of the worst three", "reported [seeds]"], lines)
