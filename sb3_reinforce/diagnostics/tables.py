"""Results as small tables of numbers with bootstrap intervals, found by name, printed, or exported to pandas."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

import torch as th

from sb3_reinforce.common.arguments import check_choice, check_integer

Row = TypeVar("Row")


@dataclass(frozen=True)
class Estimate:
    """
    An estimate with its interval.

    :param value: The estimate; NaN if it is not known
    :param low: Lower end of the interval
    :param high: Upper end of the interval
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


UNKNOWN = Estimate(float("nan"), float("nan"), float("nan"))


def resample_counts(m: int, n_resamples: int, seed: int) -> th.Tensor:
    """How often each of m samples occurs in the sample itself (row 0) and in resamples, ``(1 + n_resamples, m)``."""
    size = (check_integer("n_resamples", n_resamples, 1), m)
    drawn = th.randint(m, size, generator=th.Generator().manual_seed(check_integer("seed", seed, 0)))
    # A resample of m copies of one sample has no pairs, so one copy is replaced
    drawn[:, 1] = th.where((drawn == drawn[:, :1]).all(1), (drawn[:, 0] + 1) % m, drawn[:, 1])
    counts = th.zeros(size, dtype=th.float64).scatter_add_(1, drawn, th.ones(drawn.shape, dtype=th.float64))
    return th.cat([th.ones(1, m, dtype=th.float64), counts])


def interval(values: th.Tensor, confidence: float) -> Estimate:
    """Percentile interval of a statistic of sample and resamples (1 + r,) (Efron and Tibshirani, 1993, chapter 13)."""
    tail = (1 - confidence) / 2
    # Where a resample has no variance, a ratio is 0 / 0: it may be anything, and counts as beyond both ends
    unknown = values[1:].isnan()
    if unknown.sum() > tail * (len(unknown) - 1):
        return Estimate(float(values[0]), float("nan"), float("nan"))
    # An end is a value that occurred: infinite noise scales cannot be interpolated
    low = values[1:].masked_fill(unknown, -th.inf).quantile(tail, interpolation="lower")
    high = values[1:].masked_fill(unknown, th.inf).quantile(1 - tail, interpolation="higher")
    return Estimate(float(values[0]), float(low), float(high))


class Table(Generic[Row]):
    """
    Rows of one dataclass whose first field is a name: ``table["optimal"].variance``, ``len(table)``, ``print(table)``.

    :param title: What the table shows
    :param rows: The rows, at least one
    :param legend: What columns mean, printed below the table
    """

    def __init__(self, title: str, rows: list[Row], legend: Mapping[str, str]):
        self.title = title
        self.rows = rows
        self.legend = legend
        self.columns = [field.name for field in fields(rows[0])]  # type: ignore[arg-type]

    @property
    def names(self) -> list[str]:
        """The first column."""
        return [str(getattr(row, self.columns[0])) for row in self.rows]

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> Row:
        return self.rows[self.names.index(check_choice(self.columns[0], name, tuple(self.names)))]

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __str__(self) -> str:
        cells = [self.columns, *([as_text(getattr(row, column)) for column in self.columns] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells
        ]
        width = max(map(len, self.legend))
        return "\n".join([self.title, *lines, *(f"  {key.ljust(width)}  {text}" for key, text in self.legend.items())])

    def to_pandas(self) -> Any:
        """
        The table as a DataFrame; an estimate takes three columns, ``x``, ``x_low`` and ``x_high``.

        :return: A ``pandas.DataFrame`` with the names as its index
        :raises ImportError: If pandas is not installed
        """
        import pandas

        return pandas.DataFrame(self.to_records()).set_index(self.columns[0])

    def to_records(self) -> list[dict[str, Any]]:
        """
        The rows as dictionaries of names, numbers and texts.

        :return: One dictionary per row, with the columns of ``to_pandas``
        """
        records = []
        for row in self.rows:
            record: dict[str, Any] = {}
            for column in self.columns:
                value = getattr(row, column)
                if isinstance(value, Estimate):
                    record |= {column: value.value, f"{column}_low": value.low, f"{column}_high": value.high}
                else:
                    record[column] = value
            records.append(record)
        return records


def as_text(value: Any) -> str:
    """A cell of the printed table; an unknown number is a dash."""
    number = value.value if isinstance(value, Estimate) else value
    if number != number:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
