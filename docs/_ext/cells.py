"""The rows of ``examples/benchmarks/results``, and how numbers are written in tables."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import pandas as pd

RESULTS = Path(__file__).parents[2] / "examples" / "benchmarks" / "results"
LABELS = {
    "reinforce": "REINFORCE", "finite_difference": "FiniteDifference", "a2c": "A2C", "ppo": "PPO", "ars": "ARS",
    "reinforce_lstm": "RecurrentREINFORCE", "ppo_lstm": "RecurrentPPO", "trpo": "TRPO", "vpg": "VPG",
}  # fmt: skip
NONE = "–"


def markdown(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    header = list(header)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def read(name: str) -> pd.DataFrame:
    """A file of results."""
    return pd.read_csv(RESULTS / f"{name}.csv")


def number(value: float, digits: int = 1) -> str:
    """A number with a true minus sign; thousands have no decimals."""
    text = f"{value:.{0 if abs(value) >= 1000 else digits}f}"
    return text.replace("-", "−" if float(text) else "")


def short(steps: int) -> str:
    """A number of steps: 200k, 1M."""
    return f"{steps // 1_000_000}M" if steps % 1_000_000 == 0 else f"{steps // 1000}k"


def spread(values: pd.Series, digits: int = 1) -> str:
    """The median of the seeds, and the least and greatest."""
    if values.empty:
        return NONE
    return f"{number(values.median(), digits)} ({number(values.min(), digits)}, {number(values.max(), digits)})"


def counted(values: pd.Series) -> str:
    """The median, the least and greatest, and the number of seeds."""
    if values.empty:
        return NONE
    return f"{spread(values) if len(values) > 1 else number(values.item())} [{len(values)}]"


def by_task(rows: pd.DataFrame) -> Iterator[tuple[str, int, pd.DataFrame]]:
    """The rows of each task and number of steps, where the rows of a task need not be neighbors."""
    for task, same in rows.groupby("task", sort=False):
        for budget, runs in same.groupby("budget"):
            yield str(task), int(budget), runs
