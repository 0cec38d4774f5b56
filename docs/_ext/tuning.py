"""The table of the seeds on which the settings were chosen."""

import inspect

import yaml
from cells import RESULTS, counted, markdown, number, read, short, spread
from tables import compared

from sb3_reinforce import REINFORCE

SETTINGS = RESULTS.parents[2] / "sb3_reinforce" / "zoo" / "hyperparams" / "reinforce.yml"
DEFAULTS = {name: str(each.default) for name, each in inspect.signature(REINFORCE).parameters.items()}
DEFAULTS |= {"policy": "MlpPolicy", "normalize": "False", "train_env_kwargs": "{}"}


def shipped(task: str) -> dict[str, str]:
    """The shipped settings of a task, written as in ``tuning.csv``."""
    published = yaml.safe_load(SETTINGS.read_text(encoding="utf-8"))
    settings = {**published[task], "train_env_kwargs": published["train_env_kwargs"].get(task, {})}
    return DEFAULTS | {key: str(value).replace(" ", "") for key, value in settings.items()}


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
