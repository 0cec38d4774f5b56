"""The table of the runs behind the shipped settings."""

import inspect

import yaml
from cells import RESULTS, counted, markdown, number, read, short, spread
from tables import final

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies import natural

SETTINGS = RESULTS.parents[2] / "sb3_reinforce" / "zoo" / "hyperparams" / "reinforce.yml"
DEFAULTS = {name: str(each.default) for name, each in inspect.signature(REINFORCE).parameters.items()}
DEFAULTS |= {"policy": "MlpPolicy", "normalize": "False", "train_env_kwargs": "{}"}
# Constants of the natural step
DEFAULTS |= {"damping": str(natural.DAMPING), "n_iterations": str(natural.N_ITERATIONS)}


def shipped(task: str) -> dict[str, str]:
    """The shipped settings of a task, written as in ``tuning.csv``."""
    published = yaml.safe_load(SETTINGS.read_text())
    settings = {**published[task], "train_env_kwargs": published["train_env_kwargs"].get(task, {})}
    return DEFAULTS | {key: str(value).replace(" ", "") for key, value in settings.items()}


def changes(task: str, text: str) -> str:
    """What a line of settings changes in the shipped ones."""
    ours = shipped(task)
    theirs = DEFAULTS | dict(each.split("=", 1) for each in text.split())
    if theirs["step"] == "optimizer":
        # It has no use for a target
        del theirs["target_kl"]
    return ", ".join(f"`{key}={value}`" for key, value in theirs.items() if ours[key] != value)


def chosen_on() -> str:
    """The ten seeds of the choice beside the reported ones, with the shipped settings; a seed's later run counts."""
    rows = read("tuning").query("algorithm == 'reinforce' and 100 <= seed < 110")
    reported = final("comparison", "comparison_others").query("algorithm == 'reinforce'").groupby(["task", "budget"])
    lines = []
    for (task, budget, text), same in rows.groupby(["task", "budget", "settings"]):
        returns = same.groupby("seed")["return"].last()
        if len(returns) == 10 and not changes(str(task), text):
            shown = counted(reported.get_group((task, budget))["return"])
            worst = number(returns.nsmallest(3).mean())
            lines.append([f"{task} ({short(int(budget))})", spread(returns), worst, shown])
    return markdown(["task (steps)", "seeds 100 to 109", "mean of the worst three", "reported [seeds]"], lines)


def runs() -> str:
    """The returns of each variant, by task, on the seeds of the choice and on the reported ones."""
    rows = read("tuning").query("algorithm == 'reinforce'")
    reported = final("comparison", "comparison_others").query("algorithm == 'reinforce'")
    lines = []
    for (task, budget, text), same in rows.groupby(["task", "budget", "settings"], sort=False):
        variant = changes(str(task), text)
        shown = same[same["seed"] < 100] if variant else reported.query("task == @task and budget == @budget")
        cells = [counted(each["return"]) for each in (same[same["seed"] >= 100], shown)]
        lines.append([f"{task} ({short(int(budget))})", variant or "as shipped", *cells])
    lines.sort(key=lambda line: (line[0], line[1] != "as shipped"))
    return markdown(["task (steps)", "changes to the shipped settings", "seeds from 100 on", "reported seeds"], lines)
