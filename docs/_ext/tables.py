"""The tables of results, computed from the CSVs in ``examples/benchmarks/results``."""

import numpy as np
import pandas as pd
from cells import LABELS, NONE, by_task, counted, markdown, number, read, short, spread

# The README's tasks, each with the steps for which the Zoo tunes its PPO
README_TASKS = {
    "CartPole-v1": 100_000, "MountainCarContinuous-v0": 20_000, "Pendulum-v1": 100_000, "Acrobot-v1": 1_000_000,
    "LunarLander-v3": 1_000_000, "HalfCheetah-v5": 1_000_000, "Walker2d-v5": 1_000_000,
}  # fmt: skip
PEERS = ("a2c", "ppo", "trpo")
COMPARISONS = ("comparison", "comparison_short", "comparison_long", "comparison_others")


def published(task: str, *algorithms: str) -> str:
    """What the Zoo publishes for a task, or another source of an algorithm that it leaves out, with the steps."""
    rows = read("published")
    texts = []
    for name in algorithms:
        mine = rows[(rows["task"] == task) & (rows["algorithm"] == name)]
        zoo = mine[mine["source"].str.startswith("RL Zoo")]
        for _, row in (mine if zoo.empty else zoo).iterrows():
            source = f", {row['source'].split()[0]}" if zoo.empty else ""
            texts.append(f"{LABELS[name]} {number(row['return'])} [{short(row['timesteps'])}{source}]")
    return ", ".join(texts) or NONE


def final(*names: str) -> pd.DataFrame:
    """The final evaluations of one or more comparisons."""
    rows = pd.concat([read(name) for name in names])
    return rows[rows["evaluation"] == "final"]


def compared() -> pd.DataFrame:
    """The final evaluations of REINFORCE and its peers."""
    return final(*COMPARISONS)


def beside_peers(task: str, budget: int, runs: pd.DataFrame) -> list[str]:
    """The final returns of REINFORCE and its peers, with the task and the number of steps."""
    returns = [runs.loc[runs["algorithm"] == name, "return"] for name in ("reinforce", *PEERS)]
    return [f"{task} ({short(budget)})", *map(counted, returns)]


def comparison() -> str:
    """REINFORCE and its peers on every task that REINFORCE was run on."""
    lines = []
    for task, budget, runs in by_task(compared()):
        if "reinforce" in set(runs["algorithm"]):
            lines.append([*beside_peers(task, budget, runs), published(task, *PEERS)])
    header = ["task (steps)", "REINFORCE [seeds]", "A2C", "PPO", "TRPO", "published [steps]"]
    return markdown(header, lines)


def natural() -> str:
    """The natural step beside the optimizer's step, and TRPO with as many steps."""
    trpo = compared().query("algorithm == 'trpo'").groupby(["task", "budget"])
    lines = []
    for task, budget, runs in by_task(read("natural")):
        cells = [counted(runs[runs["step"] == step]["return"]) for step in ("natural", "optimizer")]
        lines.append([f"{task} ({short(budget)})", *cells, counted(trpo.get_group((task, budget))["return"])])
    return markdown(["task (steps)", "natural step [seeds]", "optimizer's step", "TRPO"], lines)


def seconds() -> str:
    """The CPU seconds that the runs took, on the seeds that all have."""
    lines = []
    for task, runs in final("comparison").query("seed < 5").groupby("task", sort=False):
        medians = runs.groupby("algorithm")["cpu_seconds"].median()
        lines.append([task, *(number(medians[name], 0) for name in ("reinforce", *PEERS))])
    return markdown(["task", "REINFORCE", "A2C", "PPO", "TRPO"], lines)


def curve(runs: pd.DataFrame, column: str, points: np.ndarray) -> np.ndarray:
    """The interquartile mean of the seeds' returns at values of a column."""
    returns = np.sort([np.interp(points, run[column], run["return"]) for _, run in runs.groupby("seed")], axis=0)
    cut = len(returns) // 4
    return returns[cut : len(returns) - cut].mean(axis=0)


def ahead(ours: pd.DataFrame, theirs: pd.DataFrame, column: str) -> str:
    """The share of a column's values where their curve is above ours, with the largest difference in brackets."""
    ends = [runs.loc[runs["evaluation"] == "final", column].median() for runs in (ours, theirs)]
    points = np.linspace(0, min(ends), 1001)
    lead = curve(theirs, column, points) - curve(ours, column, points)
    share = f"{100 * (lead > 0).mean():.0f}"
    return NONE if share == "0" else f"{share} % ({number(lead.max())})"


def leads() -> str:
    """How long, and by how much, other algorithms are ahead of REINFORCE, by steps and by seconds."""
    lines = []
    for name in COMPARISONS:
        for task, budget, rows in by_task(read(name)):
            # Of some runs only the final evaluation was kept
            runs = {each: mine for each, mine in rows.groupby("algorithm") if mine["seed"].value_counts().min() > 1}
            if not runs.keys() >= {"reinforce", *PEERS}:
                continue
            common = set.intersection(*(set(mine["seed"]) for mine in runs.values()))
            runs = {each: mine[mine["seed"].isin(common)] for each, mine in runs.items()}
            # Seconds of runs that were not made in one go cannot be compared
            clocks = ["steps"] if name == "comparison_others" else ["steps", "cpu_seconds"]
            cells = [ahead(runs["reinforce"], runs[peer], clock) for clock in clocks for peer in PEERS]
            lines.append([f"{task} ({short(budget)})", *cells, *[""] * (6 - len(cells))])
    columns = [f"{LABELS[peer]}, {clock}" for clock in ("steps", "seconds") for peer in PEERS]
    return markdown(["task (steps)", *columns], lines)


def readme() -> str:
    """The README's small table."""
    rows = compared().groupby(["task", "budget"])
    lines = [beside_peers(task, budget, rows.get_group((task, budget))) for task, budget in README_TASKS.items()]
    return markdown(["task (steps)", "REINFORCE [seeds]", "A2C", "PPO", "TRPO"], lines)


def memory() -> str:
    """RecurrentREINFORCE on tasks without velocities, beside RecurrentPPO where it was run."""
    rows = final("memory")
    lines = []
    for (task, budget), runs in rows[rows["algorithm"] == "reinforce_lstm"].groupby(["task", "budget"], sort=False):
        peer = rows[(rows["task"] == task) & (rows["algorithm"] == "ppo_lstm")]
        theirs = [NONE, NONE]
        if len(peer):
            theirs = [f"{spread(peer['return'])} [{short(peer['budget'].iloc[0])}]"]
            theirs.append(number(peer["cpu_seconds"].median(), 0))
        ours = [f"{spread(runs['return'])} [{short(budget)}]", number(runs["cpu_seconds"].median(), 0)]
        lines.append([task, *ours, *theirs, published(task, "ppo_lstm")])
    return markdown(["task", "RecurrentREINFORCE", "seconds", "RecurrentPPO", "seconds", "the Zoo's own"], lines)


def t_maze() -> str:
    """The mean return in the T-maze of each memory, a number per seed."""
    lines = []
    for (name, length, steps), runs in read("t_maze").groupby(["memory", "length", "timesteps"], sort=False):
        returns = ", ".join(number(value, 2) for value in runs["mean_return"])
        lines.append([f"`{name}`", str(length), short(steps), returns])
    return markdown(["memory", "corridor", "steps", "mean return of each seed"], lines)


def masks() -> str:
    """Medians of the seeds after growing numbers of steps, with the least after the last."""
    rows = read("masks")
    steps = sorted(rows["timesteps"].unique())
    lines = []
    for name, runs in rows.groupby("algorithm", sort=False):
        returns = [runs[runs["timesteps"] == step]["return"] for step in steps]
        cells = [number(values.median(), 2) for values in returns[:-1]]
        lines.append([name, *cells, f"{number(returns[-1].median(), 2)} ({number(returns[-1].min(), 2)})"])
    header = ["steps", *(str(step) for step in steps[:-1]), f"{steps[-1]} (min)"]
    return markdown(header, lines)


def masks_speed() -> str:
    """How many times the steps per second of the CPU REINFORCE makes: the median of the seeds, least and greatest."""
    rows = read("masks")
    last = rows[rows["timesteps"] == rows["timesteps"].max()].pivot(
        index="seed", columns="algorithm", values="cpu_seconds"
    )
    return spread(last["MaskablePPO"] / last["REINFORCE"])


def search_vs_ars() -> str:
    """Mean of the seeds, and each seed, beside what the Zoo publishes of ARS."""
    lines = []
    for (env, budget), runs in read("search_vs_ars").groupby(["env", "budget"], sort=False):
        cells = []
        for name in ("FiniteDifference", "ARS"):
            returns = runs[runs["algorithm"] == name].sort_values("seed")["mean_return"]
            cells.append(f"{number(returns.mean())} ({', '.join(number(value) for value in returns)})")
        lines.append([f"{env} ({short(budget)})", *cells, published(env, "ars")])
    header = ["environment (steps)", "FiniteDifference: mean (each seed)", "ARS", "the Zoo's own [steps]"]
    return markdown(header, lines)


def common_random_numbers() -> str:
    """What equal starts save in variance, and what they cost in steps."""
    rows = read("common_random_numbers")
    lines = []
    for env, runs in rows.groupby("env", sort=False):
        columns = (runs["variance_ratio"], runs["steps_ratio"])
        cells = [", ".join(f"{ratio:.1f}" for ratio in column) for column in columns]
        lines.append([env, ", ".join(runs["estimator"]), *cells])
    return markdown(["environment", "estimators", "variance without / with", "steps with / without"], lines)


def search_throughput() -> str:
    """Gradients a second beside ARS."""
    lines = [
        [row["env"], row["policy"], f"{row['median']} ({row['least']}, {row['greatest']})"]
        for _, row in read("search_throughput").iterrows()
    ]
    return markdown(["environment", "policy", "FiniteDifference / ARS: median (min, max)"], lines)


def throughput() -> str:
    """Steps a second of learning, as ratios."""
    rows = read("throughput")
    lines = [
        [f"{row['env']}, {row['n_envs']}", *(f"{row[name]:.3g}" for name in rows.columns[2:])]
        for _, row in rows.iterrows()
    ]
    return markdown(["environments", *(name.replace("raw", "VecEnv") for name in rows.columns[2:])], lines)


def peers() -> str:
    """Speed as ratios of the same seed, and what it takes to the return: medians of the seeds."""
    rows = read("peers")
    rates = rows.pivot(index="seed", columns="contender", values="rate")
    lines = []
    for name, runs in rows.groupby("contender", sort=False):
        ratio = (rates["REINFORCE"] / rates[name]).median()
        lines.append([name, f"{ratio:.1f}", *(number(runs[column].median(), 0) for column in ("steps", "seconds"))])
    return markdown(["", "REINFORCE's steps/s ÷ theirs", "steps to the return", "CPU seconds"], lines)


def images(device: str = "cpu") -> str:
    """Steps a second from images beside A2C, for each number of environments."""
    rows = read("images")
    texts = [f"{ratio:.2f}" for ratio in rows.loc[rows["device"] == device, "REINFORCE / A2C"]]
    return " and ".join(texts)


def images_on_a_gpu() -> str:
    """As ``images``, on an H100."""
    return images("cuda")


def processes() -> str:
    """Times the steps a second of one process with as many environments: medians of the rounds."""
    rows = read("processes")
    lines = []
    for milliseconds, same in rows.groupby("milliseconds"):
        rates = same.pivot_table("rate", "seed", ["kind", "number"])
        ratios = rates.div(rates["processes", 1], axis=0).median()
        measured = [f"{ratios[key]:.3g}" for key in [*(("processes", n) for n in (2, 4, 8)), ("SubprocVecEnv", 8)]]
        computed = same[same["kind"].str.startswith("computed")].set_index("number")["rate"]
        lines.append([f"{milliseconds:g} ms", *measured, f"{computed[64] / computed[1]:.2g}"])
    header = ["a step takes", "2 processes", "4", "8", "SubprocVecEnv, 8 workers", "64 processes (computed)"]
    return markdown(header, lines)


def processes_model() -> str:
    """The rate that the model computes, divided by the median of the measured ones."""
    rows = read("processes")
    measured = rows[rows["kind"] == "processes"].groupby(["milliseconds", "number"])["rate"].median()
    ratios = (rows[rows["kind"] == "model"].set_index(["milliseconds", "number"])["rate"] / measured).unstack()
    lines = [[f"{ms:g} ms", *(f"{ratio:.2f}" for ratio in row)] for ms, row in ratios.iterrows()]
    return markdown(["a step takes", *(f"{n} process{'es' * (n > 1)}" for n in ratios)], lines)
