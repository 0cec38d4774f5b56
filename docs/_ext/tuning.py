"""The table of the runs behind the shipped settings."""

import yaml
from tables import RESULTS, counted, markdown, read, short

SETTINGS = RESULTS.parents[2] / "sb3_reinforce" / "zoo" / "hyperparams" / "reinforce.yml"


def shipped(task: str) -> dict[str, str]:
    """The shipped settings of a task, written as in ``tuning.csv``."""
    settings = yaml.safe_load(SETTINGS.read_text())[task]
    return {key: str(value).replace(" ", "") for key, value in settings.items() if key not in ("n_timesteps", "policy")}


def changes(task: str, text: str) -> list[str]:
    """What a line of settings changes in the shipped ones."""
    ours = shipped(task)
    theirs = dict(each.split("=", 1) for each in text.split())
    changed = [f"`{key}={value}`" for key, value in theirs.items() if ours.get(key) != value]
    return changed + [f"no `{key}`" for key in ours if key not in theirs]


def table() -> str:
    """The returns of each variant, by task, on the seeds of the choice and on the reported ones."""
    rows = read("tuning").query("algorithm == 'reinforce'")
    lines = []
    for (task, budget, text), runs in rows.groupby(["task", "budget", "settings"], sort=False):
        is_reported = runs["seed"] < 100
        cells = [counted(runs["return"][chosen]) for chosen in (~is_reported, is_reported)]
        lines.append([f"{task} ({short(int(budget))})", ", ".join(changes(str(task), text)) or "as shipped", *cells])
    lines.sort(key=lambda line: (line[0], line[1] != "as shipped"))
    return markdown(["task (steps)", "changes to the shipped settings", "seeds from 100 on", "reported seeds"], lines)
